"""One training sample: a prompt, the contract that answers it, and its origin."""

from __future__ import annotations

from typing import Any

import msgspec

from dualbrain.contracts.scene_names import SceneNames


class DuplicateSource(msgspec.Struct, frozen=True):
    """A near-duplicate that a sample represents: its memory, and the planner that proposed it."""

    memory: str
    source: str


class Sample(msgspec.Struct, frozen=True, omit_defaults=True, kw_only=True):
    """One line of the data set: a prompt and its completion in conversational form, as TRL and other trainers read it.

    `id` identifies prompt and completion by content. `weight` is the memory weight w ∈ [0, 1] when the data set was
    made, `Delta` and `duration` [s] are those of the episode. `repeats` is the number of repetitions per epoch
    (`balancing`), `scene` the group of scenes that is on one side of the split. `memory` is the id of the memory (""
    without an episode), `source` the planner that proposed the contract. `events` are numbers of ledger events: its own
    first, then those of its near-duplicates `others` (older data sets do not name them). `graspable` and `receptive`
    are the names that a contract may use in the scene.
    """

    id: str
    prompt: list[dict[str, str]]
    completion: list[dict[str, str]]
    weight: float
    Delta: float
    duration: float
    repeats: int
    scene: str
    memory: str
    events: tuple[int, ...]
    source: str
    graspable: tuple[str, ...]
    receptive: tuple[str, ...]
    others: tuple[DuplicateSource, ...] = ()

    @property
    def memories(self) -> frozenset[str]:
        """Ids of its memory and of those of its near-duplicates; none for a sample without an episode."""
        return frozenset(filter(None, (self.memory, *(one.memory for one in self.others))))

    @property
    def contract(self) -> str:
        """The text of the contract."""
        return self.completion[0]["content"]

    @property
    def scene_names(self) -> SceneNames:
        """The names that a contract may use in this scene."""
        return SceneNames(self.graspable, self.receptive)


def encode_samples(samples: tuple[Sample, ...]) -> bytes:
    """JSON lines, one per sample, keys in the order of the fields: equal samples give equal bytes."""
    return b"".join(msgspec.json.encode(sample) + b"\n" for sample in samples)


def decode_samples(data: bytes) -> tuple[Sample, ...]:
    """The samples in `data`; raises one of `DECODE_ERRORS` for unreadable lines."""
    return tuple(msgspec.json.decode(line, type=Sample) for line in data.splitlines() if line.strip())


def assistant_turn(text: str) -> list[dict[str, Any]]:
    """`text` as a turn of the assistant."""
    return [{"role": "assistant", "content": text}]
