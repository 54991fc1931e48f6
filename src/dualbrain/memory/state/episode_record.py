"""The stored form of a memory m_i = (e_i, c_i, Δ_i, r_i, w_i, t_i), and the guidance that its outcome gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, Literal

import msgspec

from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.ledger.events import Status
from dualbrain.memory.plasticity.hebbian_update import W0, Plasticity
from dualbrain.memory.retrieval.search import MemoryHit
from dualbrain.memory.state.provenance import Provenance, episode_provenance
from dualbrain.records import Episode, Exemplar, OutcomeClass, RetrievedContext

Guidance = Literal["follow", "avoid", "none"]

GUIDANCE_BY_OUTCOME: Mapping[OutcomeClass, Guidance] = {
    "succeeded": "follow",
    "failed": "avoid",
    "taken_over": "avoid",
    "rejected": "avoid",
    "declined": "none",
    "aborted": "none",
    "stopped": "none",
    "paused": "none",
    "slowed": "none",
    "handed_over": "none",
    "emergency": "none",
}
"""Whether the contract of an outcome is to be followed or avoided. A decline, an operator command and a fault give no
guidance: these episodes are stored, but they are not retrieved and change no weight."""

STORED_EPISODE_FIELDS = (
    "id",
    "started",
    "instruction",
    "robot",
    "registry",
    "seed",
    "scene",
    "summary",
    "attempts",
    "contract",
    "outcome",
    "timings",
    "versions",
)
"""The fields of an episode that memory stores. All are known to the robot: ground truth (`judgement`) is excluded."""


class OutcomeSummary(msgspec.Struct, frozen=True):
    """The fields of an outcome that retrieval needs."""

    kind: OutcomeClass
    reason: str
    Delta: float | None


class EpisodeRecord(msgspec.Struct, frozen=True, kw_only=True):
    """The fields of a stored episode that retrieval needs."""

    id: str
    instruction: str
    robot: str
    registry: str
    summary: str
    contract: dict[str, Any] | None
    outcome: OutcomeSummary

    def to_exemplar(self, hit: MemoryHit, rank: int, parts: dict[str, float]) -> Exemplar:
        """This memory in the form for the planner; a contract that could not be parsed is {}."""
        outcome = self.outcome
        succeeded = outcome.kind == "succeeded"
        return Exemplar(
            episode_id=self.id,
            instruction=self.instruction,
            summary=self.summary,
            contract=self.contract or {},
            succeeded=succeeded,
            Delta=outcome.Delta,
            similarity=hit.similarity,
            weight=hit.weight,
            score=hit.score,
            rank=rank,
            reason="" if succeeded else outcome.reason,
            parts=parts,
        )


class MemoryHeader(msgspec.Struct, frozen=True):
    """The fields of a stored episode that weights, filters and audits need."""

    id: str
    robot: str
    registry: str
    outcome: OutcomeSummary


class EpisodeEventHeader(msgspec.Struct, frozen=True):
    """The fields of an episode event that weights, filters and audits need."""

    episode: MemoryHeader
    w0: float
    provenance: Provenance = Provenance()
    status: Status = "active"


class StoredEpisode(msgspec.Struct, frozen=True):
    """The fields of an episode event from which its vector is computed."""

    episode: EpisodeRecord
    state: Posture
    image: ImageFeatures | None = None


def episode_payload(
    episode: Episode,
    state: Posture,
    image: ImageFeatures | None,
    version: str,
    plasticity: Plasticity | None,
    status: Status,
) -> dict[str, Any]:
    """The payload of an episode event: the allowed fields of `episode`, with the current rule and embedding version."""
    return {
        "provenance": episode_provenance(episode),
        "status": status,
        "image": image,
        "episode": {name: getattr(episode, name) for name in STORED_EPISODE_FIELDS},
        "state": state,
        "retrieved": retrieved_memories(episode.recall),
        "embedding": version,
        "plasticity": None if plasticity is None else asdict(plasticity),
        "w0": W0,
    }


def retrieved_memories(recall: RetrievedContext) -> list[dict[str, Any]]:
    """The memories in the prompt, in rank order, exemplars before warnings, each once; ids without texts."""
    shown = sorted(recall.exemplars, key=_rank), sorted(recall.warnings, key=_rank)
    rows = dict[str, dict[str, Any]]()
    for kind, hits in zip(("exemplar", "warning"), shown, strict=True):
        for hit in hits:
            row = {"as": kind, "rank": hit.rank, "R": hit.score, "s": hit.similarity, "w": hit.weight}
            rows.setdefault(hit.episode_id, {"memory": hit.episode_id, **row})
    return list(rows.values())


def _rank(hit: Exemplar) -> int:
    return hit.rank


def decode_stored_episode(data: bytes) -> StoredEpisode:
    """Decode the fields for an embedding from the payload of an episode event."""
    return msgspec.json.decode(data, type=StoredEpisode)


def decode_event_header(data: bytes) -> EpisodeEventHeader:
    """Decode the fields for weights and filters from the payload of an episode event."""
    return msgspec.json.decode(data, type=EpisodeEventHeader)


def shown_exemplar_ids(recall: RetrievedContext) -> tuple[str, ...]:
    """Ids of the exemplars in the prompt, in rank order; the contract may follow one of them.

    Warnings are left out, because they are shown to be avoided: the outcome is no evidence for or against them.
    """
    return tuple(dict.fromkeys(hit.episode_id for hit in sorted(recall.exemplars, key=_rank)))


class _RetrievedMemory(msgspec.Struct, frozen=True, rename={"kind": "as"}):
    memory: str
    kind: str


class _RetrievedMemories(msgspec.Struct, frozen=True):
    retrieved: tuple[_RetrievedMemory, ...]


def decode_shown_exemplar_ids(data: bytes) -> tuple[str, ...]:
    """The result of `shown_exemplar_ids` for a stored episode, from the payload of its event."""
    return tuple(
        one.memory for one in msgspec.json.decode(data, type=_RetrievedMemories).retrieved if one.kind == "exemplar"
    )
