"""Scripts for Lift and Stack as way points of the tool, a careful and a hasty one, and one without a task.

Both kinds know where the cubes are and take the cube from above, fingers across two of its sides. The careful one goes
well over everything and stops at each way point; the hasty one keeps low, leaves out what it can and cuts corners: it
turns off when it is within 2 cm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import pi
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Pose
from dualbrain.safety.cbf.filter import ToolState
from experiments.robots.robosuite.resolved_rate import CAREFUL, HASTY, ResolvedRateController, SpeedProfile

Array = NDArray[np.float64]

GRASP_HEIGHT = 0.0
"""Height of the tool over the cube's middle when it takes it [m]; the pads of the suite's fingers sit 1 cm higher."""
STACK_OFFSET = 0.045
"""Between the middles of a cube of 4 cm and of the one of 5 cm that it stands on [m]."""
WAYPOINT_TIMEOUT_S = 10.0
"""After this the next way point is taken, reached or not [s]: long, as a filtered arm may be much slower."""


@dataclass(frozen=True, slots=True)
class Waypoint:
    """Where the tool goes next: `height` [m] over the middle of the cube `over`, as that stands when the way begins.

    With `closed` fingers; done when within `near` [m], and then `dwell` [s] later. `carries` names the cube that is to
    come there instead of the tool. `touching` the cube may be set down.
    """

    name: str
    target_cube: str
    height: float
    closed: bool
    tolerance: float
    dwell: float = 0.0
    carried_cube: str = ""
    may_touch: str = ""


def lift_waypoints(hasty: bool) -> tuple[Waypoint, ...]:
    """Take the cube and lift it."""
    if hasty:
        return (
            Waypoint("over", "cube", 0.03, False, 0.02),
            Waypoint("down", "cube", GRASP_HEIGHT, False, 0.01),
            Waypoint("close", "cube", GRASP_HEIGHT, True, 0.02, 0.25),
            Waypoint("up", "cube", 0.12, True, 0.02, 0.2),
        )
    return (
        Waypoint("over", "cube", 0.10, False, 0.01),
        Waypoint("down", "cube", GRASP_HEIGHT, False, 0.003),
        Waypoint("close", "cube", GRASP_HEIGHT, True, 0.01, 0.4),
        Waypoint("up", "cube", 0.12, True, 0.01, 0.3),
    )


def stack_waypoints(hasty: bool) -> tuple[Waypoint, ...]:
    """Take one cube and put it on the other; the hasty way leads straight there, past the other's corner."""
    put = STACK_OFFSET + GRASP_HEIGHT
    if hasty:
        return (
            Waypoint("over", "cubeA", 0.03, False, 0.02),
            Waypoint("down", "cubeA", GRASP_HEIGHT, False, 0.01),
            Waypoint("close", "cubeA", GRASP_HEIGHT, True, 0.02, 0.25),
            Waypoint("across", "cubeB", put + 0.01, True, 0.02, carried_cube="cubeA"),
            Waypoint("lower", "cubeB", put + 0.002, True, 0.005, carried_cube="cubeA", may_touch="cubeB"),
            Waypoint("open", "cubeB", put + 0.002, False, 0.02, 0.25, carried_cube="cubeA", may_touch="cubeB"),
            Waypoint("away", "cubeB", put + 0.10, False, 0.03, 0.1),
        )
    return (
        Waypoint("over", "cubeA", 0.10, False, 0.01),
        Waypoint("down", "cubeA", GRASP_HEIGHT, False, 0.003),
        Waypoint("close", "cubeA", GRASP_HEIGHT, True, 0.01, 0.4),
        Waypoint("up", "cubeA", 0.12, True, 0.01),
        Waypoint("across", "cubeB", put + 0.06, True, 0.005, carried_cube="cubeA"),
        Waypoint("lower", "cubeB", put + 0.002, True, 0.003, 0.2, carried_cube="cubeA", may_touch="cubeB"),
        Waypoint("open", "cubeB", put + 0.002, False, 0.01, 0.5, carried_cube="cubeA", may_touch="cubeB"),
        Waypoint("away", "cubeB", put + 0.10, False, 0.01, 0.3),
    )


TASKS = {"Lift": lift_waypoints, "Stack": stack_waypoints}


class Policy(Protocol):
    """What is flown: joint velocities from the state, way point by way point."""

    done: bool
    waypoint: Waypoint
    """The way point it is at."""

    def nominal(self, now: float, q: Array, tool: ToolState, cubes: Mapping[str, Pose]) -> Array:
        """Joint velocities (n,) [rad/s] at time `now` [s]."""
        ...


class WaypointPolicy:
    """Way points in their order, each from where the cubes are when it begins."""

    def __init__(
        self, points: Sequence[Waypoint], pace: SpeedProfile, fastest: Array, posture: Array, period: float
    ) -> None:
        self.done, self.waypoint = False, points[0]
        self._remaining = list(points[1:])
        self._controller = ResolvedRateController(pace, fastest, posture, period)
        self._goal: tuple[Array, Array] | None = None
        self._rotation: Array | None = None
        self._began, self._reached = 0.0, float("inf")

    def nominal(self, now: float, q: Array, tool: ToolState, cubes: Mapping[str, Pose]) -> Array:
        """Toward the present way point; on to the next when it is reached for long enough, or takes too long."""
        if self._goal is not None and self._is_over(now, tool):
            self.done = not self._remaining
            self.waypoint = self._remaining.pop(0) if self._remaining else self.waypoint
            self._goal = None if not self.done else self._goal
        if self._goal is None:
            self._goal, self._began, self._reached = self._target_pose(tool, cubes), now, float("inf")
        return self._controller.joint_velocity(tool, q, *self._goal)

    def _is_over(self, now: float, tool: ToolState) -> bool:
        assert self._goal is not None
        near = float(np.linalg.norm(self._goal[0] - tool.position)) <= self.waypoint.tolerance
        self._reached = min(self._reached, now) if near or self._reached < now else self._reached
        return now - self._reached >= self.waypoint.dwell or now - self._began > WAYPOINT_TIMEOUT_S

    def _target_pose(self, tool: ToolState, cubes: Mapping[str, Pose]) -> tuple[Array, Array]:
        """Position and rotation of the tool at the present way point."""
        point = self.waypoint
        position = np.array(cubes[point.target_cube].position) + np.array([0.0, 0.0, point.height])
        if point.carried_cube:
            position[:2] += (tool.position - np.array(cubes[point.carried_cube].position))[:2]
        if self._rotation is None:
            self._rotation = grasp_rotation(tool.rotation, cubes[point.target_cube])
        return position, self._rotation


def grasp_rotation(rotation: Array, cube: Pose) -> Array:
    """The tool pointing down, its fingers across two sides of `cube`: of the four ways the one that turns least."""
    side, now = quaternion_to_matrix(cube.quaternion)[:, 0], rotation[:, 0]
    turn = np.arctan2(side[1], side[0]) - np.arctan2(now[1], now[0])
    heading = np.arctan2(now[1], now[0]) + (turn + pi / 4) % (pi / 2) - pi / 4
    x, z = np.array([np.cos(heading), np.sin(heading), 0.0]), np.array([0.0, 0.0, -1.0])
    return np.column_stack([x, np.cross(z, x), z])


class BangBangPolicy:
    """Every joint at full speed either way, changed after 0.15 to 1 s: no task, fingers open."""

    def __init__(self, fastest: Array, cube: str, seed: int, lasts: float) -> None:
        self.done, self.waypoint = False, Waypoint("anywhere", cube, 0.0, False, 0.0)
        self._rng, self._max_speed, self._duration = np.random.default_rng(seed), fastest, lasts
        self._until, self._u = 0.0, np.zeros(len(fastest))

    def nominal(self, now: float, q: Array, tool: ToolState, cubes: Mapping[str, Pose]) -> Array:
        """Full speed."""
        del q, tool, cubes
        if now >= self._until:
            self._u = np.where(self._rng.random(len(self._max_speed)) < 0.5, -1.0, 1.0) * self._max_speed
            self._until = now + float(self._rng.uniform(0.15, 1.0))
        self.done = now >= self._duration
        return self._u


SPEED_PROFILES = {"careful": CAREFUL, "hasty": HASTY}
