"""Records of a rollout."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, eq=False)
class Observation:
    images: Mapping[str, Any] = field(default_factory=dict)
    state: Mapping[str, Any] = field(default_factory=dict)
    instruction: str | None = None
    image_times: Mapping[str, float] = field(default_factory=dict)
    state_time: float = 0.0
    extra: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Action:
    data: Any
    meta: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class StepResult:
    observation: Observation
    reward: float | None = None
    terminated: bool = False
    termination_reason: str | None = None
    truncated: bool = False
    info: Mapping[str, Any] = field(default_factory=dict)
