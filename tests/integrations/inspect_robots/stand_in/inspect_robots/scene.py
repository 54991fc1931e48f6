"""The initial condition of an episode."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Scene:
    id: str
    instruction: str
    target: Any = None
    init_seed: int | None = None
    setup: str | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)
