"""One memory m_i = (e_i, c_i, Δ_i, r_i, w_i, t_i) as it lies in the ledger, and which lesson its outcome teaches."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, Literal

import msgspec

from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.ledger.events import Status
from dualbrain.memory.plasticity.rule import W0, Plasticity
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
"""What an outcome says of its contract. A decline, a person's hand and a fault say nothing of it: such episodes are
kept, but they are offered to no one and change no weight."""

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
"""The fields of an episode that memory keeps: the robot's own side. Simulator truth (`judgement`) is not among them."""


class OutcomeSummary(msgspec.Struct, frozen=True):
    """The part of an outcome that retrieval needs."""

    kind: OutcomeClass
    reason: str
    Delta: float | None


class EpisodeRecord(msgspec.Struct, frozen=True, kw_only=True):
    """The part of a stored episode that retrieval needs."""

    id: str
    instruction: str
    robot: str
    registry: str
    summary: str
    contract: dict[str, Any] | None
    outcome: OutcomeSummary

    def to_exemplar(self, hit: MemoryHit, rank: int, parts: dict[str, float]) -> Exemplar:
        """This memory as the planner gets it; a contract that never parsed is {}."""
        told = self.outcome
        succeeded = told.kind == "succeeded"
        return Exemplar(
            episode_id=self.id,
            instruction=self.instruction,
            summary=self.summary,
            contract=self.contract or {},
            succeeded=succeeded,
            Delta=told.Delta,
            similarity=hit.similarity,
            weight=hit.weight,
            score=hit.score,
            rank=rank,
            reason="" if succeeded else told.reason,
            parts=parts,
        )


class MemoryHeader(msgspec.Struct, frozen=True):
    """The part of a stored episode that weights, filters and audits need."""

    id: str
    robot: str
    registry: str
    outcome: OutcomeSummary


class EpisodeEventHeader(msgspec.Struct, frozen=True):
    """The part of an episode event that weights, filters and audits need."""

    episode: MemoryHeader
    w0: float
    provenance: Provenance = Provenance()
    status: Status = "active"


class StoredEpisode(msgspec.Struct, frozen=True):
    """The part of an episode event from which its vector can be made again."""

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
    """What is written of `episode`, by an allow-list of its fields, with the rule and embedding then in force."""
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
    """The memories that stood in the prompt, in rank order, exemplars before warnings, each once; ids, not texts."""
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
    """What an embedding needs, from the payload of an episode event."""
    return msgspec.json.decode(data, type=StoredEpisode)


def decode_event_header(data: bytes) -> EpisodeEventHeader:
    """What weights and filters need, from the payload of an episode event."""
    return msgspec.json.decode(data, type=EpisodeEventHeader)


def shown_exemplar_ids(recall: RetrievedContext) -> tuple[str, ...]:
    """Ids of the exemplars that stood in the prompt, in rank order: one of them may have been followed.

    A warning was shown so that it be not followed: a success says nothing for it, a failure nothing against it.
    """
    return tuple(dict.fromkeys(hit.episode_id for hit in sorted(recall.exemplars, key=_rank)))


class _RetrievedMemory(msgspec.Struct, frozen=True, rename={"kind": "as"}):
    memory: str
    kind: str


class _RetrievedMemories(msgspec.Struct, frozen=True):
    retrieved: tuple[_RetrievedMemory, ...]


def decode_shown_exemplar_ids(data: bytes) -> tuple[str, ...]:
    """What `shown` said of an episode, from the payload of its event."""
    return tuple(
        one.memory for one in msgspec.json.decode(data, type=_RetrievedMemories).retrieved if one.kind == "exemplar"
    )
