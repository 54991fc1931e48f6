"""One training sample: a prompt, the contract that answers it, and where it came from."""

from __future__ import annotations

from typing import Any

import msgspec

from dualbrain.contracts.scene_names import SceneNames


class DuplicateSource(msgspec.Struct, frozen=True):
    """A near-duplicate that a sample stands for: its memory, and who proposed it."""

    memory: str
    source: str


class Sample(msgspec.Struct, frozen=True, omit_defaults=True, kw_only=True):
    """One line of the data set: a prompt and its completion in conversational form, as TRL and others read it.

    `id` names prompt and completion by content. `weight` is the memory weight w ∈ [0, 1] when the set was made, `Delta`
    and `duration` [s] those of the episode. `repeats` is how often an epoch shows it (see `balance`), `scene` names the
    group of scenes that stays on one side of the split. `events` are the numbers of its events in the ledger: its own
    first, then those of the near-duplicates it stands for, `others` (older sets do not name them). `graspable` and
    `receptive` are the names a contract could use there.
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
        """Whose memory it is, and those of its near-duplicates."""
        return frozenset((self.memory, *(one.memory for one in self.others)))

    @property
    def contract(self) -> str:
        """The contract's text."""
        return self.completion[0]["content"]

    @property
    def scene_names(self) -> SceneNames:
        """The names that a contract may use in this scene."""
        return SceneNames(self.graspable, self.receptive)


def encode_samples(samples: tuple[Sample, ...]) -> bytes:
    """Lines of JSON, one sample each, keys in the order of the fields: the same samples give the same bytes."""
    return b"".join(msgspec.json.encode(sample) + b"\n" for sample in samples)


def decode_samples(data: bytes) -> tuple[Sample, ...]:
    """The samples of `data`; raises what is `UNREADABLE`."""
    return tuple(msgspec.json.decode(line, type=Sample) for line in data.splitlines() if line.strip())


def assistant_turn(text: str) -> list[dict[str, Any]]:
    """`text` as the turn of the assistant."""
    return [{"role": "assistant", "content": text}]
