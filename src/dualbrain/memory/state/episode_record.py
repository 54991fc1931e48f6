"""One memory m_i = (e_i, c_i, Δ_i, r_i, w_i, t_i) as it lies in the ledger, and which lesson its outcome teaches."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, Literal

import msgspec

from dualbrain.memory.embedding.image_features import Picture
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.ledger.events import Status
from dualbrain.memory.plasticity.rule import W0, Plasticity
from dualbrain.memory.retrieval.search import Hit
from dualbrain.memory.state.provenance import Provenance, provenance_of
from dualbrain.records import Episode, Exemplar, OutcomeClass, Recall

Lesson = Literal["follow", "avoid", "none"]

LESSONS: Mapping[OutcomeClass, Lesson] = {
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

STORED = (
    "id", "started", "instruction", "robot", "registry", "seed", "scene", "summary",
    "attempts", "contract", "outcome", "timings", "versions",
)  # fmt: skip
"""The fields of an episode that memory keeps: the robot's own side. Simulator truth (`judgement`) is not among them."""


class Told(msgspec.Struct, frozen=True):
    """The part of an outcome that retrieval needs."""

    kind: OutcomeClass
    reason: str
    Delta: float | None


class Trace(msgspec.Struct, frozen=True):
    """The part of a stored episode that retrieval needs."""

    id: str
    instruction: str
    robot: str
    registry: str
    summary: str
    contract: dict[str, Any] | None
    outcome: Told

    def exemplar(self, hit: Hit, rank: int, parts: dict[str, float]) -> Exemplar:
        """This memory as the planner gets it; a contract that never parsed is {}."""
        told = self.outcome
        succeeded = told.kind == "succeeded"
        return Exemplar(
            self.id, self.instruction, self.summary, self.contract or {}, succeeded, told.Delta,
            hit.similarity, hit.weight, hit.score, rank, reason="" if succeeded else told.reason, parts=parts,
        )  # fmt: skip


class ToldMemo(msgspec.Struct, frozen=True):
    """The part of a stored episode that weights, filters and audits need."""

    id: str
    robot: str
    registry: str
    outcome: Told


class MemoHead(msgspec.Struct, frozen=True):
    """The part of an episode event that weights, filters and audits need."""

    episode: ToldMemo
    w0: float
    provenance: Provenance = Provenance()
    status: Status = "active"


class Stored(msgspec.Struct, frozen=True):
    """The part of an episode event from which its vector can be made again."""

    episode: Trace
    state: Posture
    image: Picture | None = None


def payload(
    episode: Episode, state: Posture, image: Picture | None, version: str, plasticity: Plasticity | None, status: Status
) -> dict[str, Any]:
    """What is written of `episode`, by an allow-list of its fields, with the rule and embedding then in force."""
    return {
        "provenance": provenance_of(episode),
        "status": status,
        "image": image,
        "episode": {name: getattr(episode, name) for name in STORED},
        "state": state,
        "retrieved": retrieved(episode.recall),
        "embedding": version,
        "plasticity": None if plasticity is None else asdict(plasticity),
        "w0": W0,
    }


def retrieved(recall: Recall) -> list[dict[str, Any]]:
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


def read_stored(data: bytes) -> Stored:
    """What an embedding needs, from the payload of an episode event."""
    return msgspec.json.decode(data, type=Stored)


def read_memo(data: bytes) -> MemoHead:
    """What weights and filters need, from the payload of an episode event."""
    return msgspec.json.decode(data, type=MemoHead)


def shown(recall: Recall) -> tuple[str, ...]:
    """Ids of the exemplars that stood in the prompt, in rank order: one of them may have been followed.

    A warning was shown so that it be not followed: a success says nothing for it, a failure nothing against it.
    """
    return tuple(dict.fromkeys(hit.episode_id for hit in sorted(recall.exemplars, key=_rank)))


class _Shown(msgspec.Struct, frozen=True, rename={"kind": "as"}):
    memory: str
    kind: str


class _Prompt(msgspec.Struct, frozen=True):
    retrieved: tuple[_Shown, ...]


def read_shown(data: bytes) -> tuple[str, ...]:
    """What `shown` said of an episode, from the payload of its event."""
    return tuple(one.memory for one in msgspec.json.decode(data, type=_Prompt).retrieved if one.kind == "exemplar")
