"""What a skill says to the local layer each tick, and what it is given to say it with.

A skill is a story told as a generator: it yields one `Nominal` a tick, None after each piece of thinking (`thought`),
and ends with an `Ending`. The local layer drives it through `Running.nominal(senses)` (the map φ of paper 4.2).
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field
from enum import Enum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dualbrain.records import Scene, SceneObject
from dualbrain.robots.interface import RobotState

Array = NDArray[np.float64]


class SkillStatus(Enum):
    """How a skill stands: still running, done, failed by its own verdict, or given up because nothing moved."""

    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    TAKEN_OVER = "taken_over"


@dataclass(frozen=True, slots=True)
class PermittedContact:
    """A contact that the current phase needs: sphere group `robot_part` may meet `obstacle` at up to `speed` [m/s]."""

    robot_part: str
    obstacle: str
    speed: float


@dataclass(frozen=True, slots=True)
class HeldObject:
    """A thing between the fingers: its `name`, and how far its lowest point lies below the tool [m]."""

    name: str
    below_tool: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Nominal:
    """One tick of intent: joint velocity u (n,) [rad/s], opening per finger [m], grip force [N], phase, contacts."""

    u: Array
    opening: float
    force: float
    phase: str
    contacts: tuple[PermittedContact, ...] = ()
    holding: HeldObject | None = None


@dataclass(frozen=True, slots=True)
class SkillResult:
    """Why a skill is over."""

    status: SkillStatus
    reason: str


SkillRoutine = Generator[Nominal | None, None, SkillResult]
"""A skill as it runs."""


class ToolState(Protocol):
    """Where the tool is: position (3,) [m], rotation (3, 3), Jacobian (6, n) of linear then angular velocity."""

    @property
    def position(self) -> Array:
        """Tool origin in the world [m]."""
        ...

    @property
    def rotation(self) -> Array:
        """Columns are the tool axes in the world; z is the approach, y the finger axis."""
        ...

    @property
    def jacobian(self) -> Array:
        """Maps joint velocity to linear then angular tool velocity."""
        ...


class MotionModel(Protocol):
    """What the local layer lends to the skills: kinematics, and the projection onto the rows that φ knows."""

    def tool(self, q: Array) -> ToolState:
        """Forward kinematics of the tool."""
        ...

    def spheres(self, q: Array, opening: float) -> tuple[Array, Array, tuple[str, ...]]:
        """Centres (k, 3) [m], radii (k,) [m] and group of every sphere of the body, those of a held thing last."""
        ...

    @property
    def keep_out_boxes(self) -> tuple[SceneObject, ...]:
        """Boxes that nobody perceives and that stay closed for good, by the site's word."""
        ...

    def project(self, state: RobotState, u_desired: Array, u_nom_prev: Array, now: float) -> Array:
        """The closest control to `u_wish` that respects known things, limits, and the box around `u_nom_prev`."""
        ...


@dataclass(slots=True, kw_only=True)
class Observation:
    """What the skill sees this tick; replaced before every step of the story.

    `waited` [s] is how long the story was held up by a person (paused, or slowed): patience does not run meanwhile.
    """

    state: RobotState
    scene: Scene
    now: float
    tool: ToolState = field(repr=False)
    paused_time: float = 0.0

    @property
    def active_time(self) -> float:
        """The clock by which a story loses its patience [s]."""
        return self.now - self.paused_time
