"""Spaces and the meaning of actions."""

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class ActionSemantics:
    control_mode: str
    rotation_repr: str = "none"
    gripper: str = "none"
    frame: str = "base"
    dim_labels: tuple[str, ...] | None = None
    max_step: tuple[float | None, ...] | None = None


@dataclass(frozen=True, eq=False)
class Box:
    shape: tuple[int, ...]
    low: Any = None
    high: Any = None
    semantics: ActionSemantics | None = None

    @property
    def dim(self):
        """The number of entries."""
        count = 1
        for length in self.shape:
            count *= length
        return count


@dataclass(frozen=True)
class StateField:
    key: str
    shape: tuple[int, ...]
    unit: str = ""
    dtype: str = "float64"


@dataclass(frozen=True)
class StateSpec:
    fields: tuple[StateField, ...] = ()


@dataclass(frozen=True)
class ObservationSpace:
    cameras: tuple[Any, ...] = ()
    state_keys: frozenset[str] = field(default_factory=frozenset)
    state: StateSpec | None = None

    def __post_init__(self):
        """The keys are those of the fields, if there are any."""
        if self.state is not None and not self.state_keys:
            object.__setattr__(self, "state_keys", frozenset(one.key for one in self.state.fields))
