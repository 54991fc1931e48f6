"""One memory m_i = (e_i, c_i, Δ_i, r_i, w_i, t_i) as it lies in the ledger, and which lesson its outcome teaches."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, Literal

import msgspec

from dualbrain.memory.plasticity import W0, Plasticity
from dualbrain.memory.posture import Posture
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

    @property
    def lesson(self) -> Lesson:
        """Whether the contract is to be followed, avoided, or neither."""
        return LESSONS[self.outcome.kind]

    @property
    def partition(self) -> tuple[str, str, Lesson]:
        """Memories are compared only inside one robot, one registry and one lesson."""
        return self.robot, self.registry, self.lesson

    def exemplar(self, *, similarity: float, weight: float, score: float, rank: int) -> Exemplar:
        """This memory as the planner gets it; a contract that never parsed is {}."""
        told = self.outcome
        succeeded = told.kind == "succeeded"
        return Exemplar(
            self.id, self.instruction, self.summary, self.contract or {}, succeeded, told.Delta,
            similarity, weight, score, rank, reason="" if succeeded else told.reason,
        )  # fmt: skip


class Weighing(msgspec.Struct, frozen=True):
    """Payload of a weight event: outcome of episode `cause` moved the weight of `memory` from `before` to `after`.

    `rank` is the place of the memory in the prompt, 0 for the new memory itself. `gain` and `offset` are the clipped
    affine map that was applied, so that a replay needs neither rule nor index.
    """

    cause: str
    memory: str
    rule: Literal["reinforce", "suppress"]
    rank: int
    gain: float
    offset: float
    before: float
    after: float


class _Stored(msgspec.Struct, frozen=True):
    episode: Trace
    state: Posture
    w0: float


def payload(episode: Episode, state: Posture, version: str, plasticity: Plasticity | None) -> dict[str, Any]:
    """What is written of `episode`, by an allow-list of its fields, with the rule and embedding then in force."""
    return {
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


def read_episode(data: bytes) -> tuple[Trace, Posture, float]:
    """Trace, posture and first weight from the payload of an episode event."""
    stored = msgspec.json.decode(data, type=_Stored)
    return stored.episode, stored.state, stored.w0


def read_weighing(data: bytes) -> Weighing:
    """The payload of a weight event."""
    return msgspec.json.decode(data, type=Weighing)
