"""The description and the protocol of embodiments."""

from dataclasses import dataclass, field
from typing import Any, Protocol

from inspect_robots.spaces import Box, ObservationSpace


@dataclass(frozen=True)
class EmbodimentInfo:
    name: str
    action_space: Box
    observation_space: ObservationSpace
    control_hz: float | None = None
    is_simulated: bool = False
    capabilities: frozenset[str] = field(default_factory=frozenset)
    supported_setups: frozenset[str] = field(default_factory=frozenset)
    supported_target_kinds: frozenset[str] = field(default_factory=frozenset)
    docs: str | None = None
    environment_id: str | None = None
    environment_revision: str | None = None


class Embodiment(Protocol):
    info: Any

    def reset(self, scene, *, seed=None): ...

    def step(self, action): ...

    def close(self): ...
