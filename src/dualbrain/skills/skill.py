"""Interface of skills: their input and output in each tick, and the functions that the control loop provides.

A skill is a generator (`SkillRoutine`). It yields one `Nominal` per tick, or None after each step of a time-sliced
computation (`time_slicing`), and returns a `SkillResult`. `SkillExecution.nominal` advances it by one tick (the map φ
of paper 4.2).
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field
from enum import Enum
from math import inf
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dualbrain.records import FailureCause, Scene, SceneObject
from dualbrain.robots.interface import RobotState

Array = NDArray[np.float64]


class SkillStatus(Enum):
    """Status of a skill: still running, done, failed by its own check, or taken over because of missing progress."""

    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    TAKEN_OVER = "taken_over"


@dataclass(frozen=True, slots=True)
class PermittedContact:
    """A contact that the current phase needs: `robot_part` may approach `obstacle` at up to `speed` [m/s]."""

    robot_part: str
    obstacle: str
    speed: float


@dataclass(frozen=True, slots=True)
class HeldObject:
    """An object between the fingers: its `name`, and the distance of its lowest point below the tool [m]."""

    name: str
    below_tool: float

    def speed_limit(self, scene: Scene) -> float:
        """Largest speed [m/s] that the site allows with this object in the hand; infinite without a limit."""
        obj = next((one for one in scene.objects if one.name == self.name), None)
        limit = obj.limits.speed if obj and obj.limits else None
        return inf if limit is None else limit


@dataclass(frozen=True, slots=True, kw_only=True)
class Nominal:
    """Output of one tick: joint velocity u (n,) [rad/s], opening per finger [m], grip force [N], phase, contacts."""

    u: Array
    opening: float
    force: float
    phase: str
    contacts: tuple[PermittedContact, ...] = ()
    holding: HeldObject | None = None


@dataclass(frozen=True, slots=True)
class SkillResult:
    """Status and reason with which a skill ended, and the cause if its own check failed it or took it over."""

    status: SkillStatus
    reason: str
    cause: FailureCause | None = None


SkillRoutine = Generator[Nominal | None, None, SkillResult]
"""A running skill."""


class ToolState(Protocol):
    """Pose of the tool: position (3,) [m], rotation (3, 3); Jacobian (6, n) of linear, then angular velocity."""

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


class ContactForce(Protocol):
    """Contact force on the arm, as estimated from its force sensing; `felt_load` is the weight in the hand [kg].

    `vector` (3,) [N] acts on the robot at `place` ("tool" or the name of a link), in the axes of the world, and has the
    length `magnitude`, of which at most `uncertainty` [N] is an error of the sensor. `load` [kg] is the weight that was
    identified after the grasp and is not part of the force; `felt_load` is identified continuously.
    """

    @property
    def vector(self) -> tuple[float, float, float]:
        """Force [N]."""
        ...

    @property
    def magnitude(self) -> float:
        """Length of the force [N]."""
        ...

    @property
    def place(self) -> str:
        """Where the force acts."""
        ...

    @property
    def uncertainty(self) -> float:
        """Largest error of the sensor [N]."""
        ...

    @property
    def load(self) -> float:
        """Identified weight in the hand [kg]."""
        ...

    @property
    def felt_load(self) -> float:
        """Weight that is felt now [kg]."""
        ...


class MotionModel(Protocol):
    """Functions that the control loop provides to skills: kinematics, and the projection onto rows known to φ."""

    def tool(self, q: Array) -> ToolState:
        """The tool frame in the world at configuration q, (n,) or for a mobile base (n + 1,) [rad, m].

        Raises:
            ConfigurationError: q does not have this shape, or does not consist of numbers.
        """
        ...

    def spheres(self, q: Array, opening: float | None) -> tuple[Array, Array, tuple[str, ...]]:
        """Centres (k, 3) [m], radii (k,) [m] and group of every sphere; spheres of a grasped object are last."""
        ...

    def damped_least_squares(self, J: Array, damping: float, task: Array, free: Array) -> Array:
        """Jᵀ (J Jᵀ + λ² 1)⁻¹ (task − J free) + free (n,): the joint motion that moves the tool by `task` (6,).

        `J` (6, n) is the Jacobian of the tool, `damping` is λ² > 0: the motion is finite at singular postures, at the
        price of a small error of the task. `free` (n,) acts within the null space of J.
        """
        ...

    @property
    def keep_out_boxes(self) -> tuple[SceneObject, ...]:
        """Boxes that the site file keeps closed; they are not part of the perceived scene."""
        ...

    def project(self, state: RobotState, u_desired: Array, u_nom_prev: Array, now: float) -> Array:
        """The control (n,) closest to `u_desired` that respects known obstacles, limits, and a box around `u_nom_prev`.

        `u_desired` (n,) is the control that the skill wants, `u_nom_prev` (n,) the nominal control of the previous
        tick; the box around it holds the controls that the acceleration limits allow. Controls are in rad/s, for a
        mobile base (v, ω) in m/s and rad/s before the joints. `now` [s] is on the clock of `state.stamp`.

        Raises:
            ConfigurationError: an array does not have its shape, or does not consist of numbers.
        """
        ...


@dataclass(slots=True, kw_only=True)
class Observation:
    """Input of a skill in one tick; replaced before every step of the routine.

    `paused_time` [s] is the time for which a person has paused or slowed the skill; time limits do not count it.
    `contact_force` is None without force sensing, while the drive is off, and until the first estimate.
    """

    state: RobotState
    scene: Scene
    now: float
    tool: ToolState = field(repr=False)
    paused_time: float = 0.0
    contact_force: ContactForce | None = None

    @property
    def active_time(self) -> float:
        """Time by which a routine measures its time limits [s]."""
        return self.now - self.paused_time
