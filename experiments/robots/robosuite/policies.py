"""Scripted policies for Lift and Stack as waypoints of the tool, careful and hasty, and a random one without a task.

The scripts know the positions of the cubes and grasp a cube from above, with the fingers across two of its sides. The
careful policy passes high above all objects and stops at each waypoint; the hasty one stays low, skips waypoints and
cuts corners: it proceeds to the next waypoint from 2 cm away.
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
"""Height of the tool above the cube's centre at the grasp [m]; the suite's finger pads are 1 cm higher."""
STACK_OFFSET = 0.045
"""Distance of the centres of a 4 cm cube and the 5 cm cube below it [m]."""
WAYPOINT_TIMEOUT_S = 10.0
"""Time after which the policy proceeds to the next waypoint [s]; long, because a filtered arm may be much slower."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Waypoint:
    """A waypoint: the tool moves to `height` [m] above the initial centre of `target_cube`, fingers `closed` or open.

    It is reached within `tolerance` [m], and over `dwell` [s] later. With `carried_cube`, that cube moves there instead
    of the tool. The held cube may touch the cube `may_touch`.
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
    """Grasp the cube and lift it."""
    if hasty:
        return (
            Waypoint(name="over", target_cube="cube", height=0.03, closed=False, tolerance=0.02),
            Waypoint(name="down", target_cube="cube", height=GRASP_HEIGHT, closed=False, tolerance=0.01),
            Waypoint(name="close", target_cube="cube", height=GRASP_HEIGHT, closed=True, tolerance=0.02, dwell=0.25),
            Waypoint(name="up", target_cube="cube", height=0.12, closed=True, tolerance=0.02, dwell=0.2),
        )
    return (
        Waypoint(name="over", target_cube="cube", height=0.10, closed=False, tolerance=0.01),
        Waypoint(name="down", target_cube="cube", height=GRASP_HEIGHT, closed=False, tolerance=0.003),
        Waypoint(name="close", target_cube="cube", height=GRASP_HEIGHT, closed=True, tolerance=0.01, dwell=0.4),
        Waypoint(name="up", target_cube="cube", height=0.12, closed=True, tolerance=0.01, dwell=0.3),
    )


def stack_waypoints(hasty: bool) -> tuple[Waypoint, ...]:
    """Grasp one cube and place it on the other; the hasty path leads straight there, past the other cube's corner."""
    put = STACK_OFFSET + GRASP_HEIGHT
    if hasty:
        return (
            Waypoint(name="over", target_cube="cubeA", height=0.03, closed=False, tolerance=0.02),
            Waypoint(name="down", target_cube="cubeA", height=GRASP_HEIGHT, closed=False, tolerance=0.01),
            Waypoint(name="close", target_cube="cubeA", height=GRASP_HEIGHT, closed=True, tolerance=0.02, dwell=0.25),
            Waypoint(
                name="across", target_cube="cubeB", height=put + 0.01, closed=True, tolerance=0.02, carried_cube="cubeA"
            ),
            Waypoint(
                name="lower",
                target_cube="cubeB",
                height=put + 0.002,
                closed=True,
                tolerance=0.005,
                carried_cube="cubeA",
                may_touch="cubeB",
            ),
            Waypoint(
                name="open",
                target_cube="cubeB",
                height=put + 0.002,
                closed=False,
                tolerance=0.02,
                dwell=0.25,
                carried_cube="cubeA",
                may_touch="cubeB",
            ),
            Waypoint(name="away", target_cube="cubeB", height=put + 0.10, closed=False, tolerance=0.03, dwell=0.1),
        )
    return (
        Waypoint(name="over", target_cube="cubeA", height=0.10, closed=False, tolerance=0.01),
        Waypoint(name="down", target_cube="cubeA", height=GRASP_HEIGHT, closed=False, tolerance=0.003),
        Waypoint(name="close", target_cube="cubeA", height=GRASP_HEIGHT, closed=True, tolerance=0.01, dwell=0.4),
        Waypoint(name="up", target_cube="cubeA", height=0.12, closed=True, tolerance=0.01),
        Waypoint(
            name="across", target_cube="cubeB", height=put + 0.06, closed=True, tolerance=0.005, carried_cube="cubeA"
        ),
        Waypoint(
            name="lower",
            target_cube="cubeB",
            height=put + 0.002,
            closed=True,
            tolerance=0.003,
            dwell=0.2,
            carried_cube="cubeA",
            may_touch="cubeB",
        ),
        Waypoint(
            name="open",
            target_cube="cubeB",
            height=put + 0.002,
            closed=False,
            tolerance=0.01,
            dwell=0.5,
            carried_cube="cubeA",
            may_touch="cubeB",
        ),
        Waypoint(name="away", target_cube="cubeB", height=put + 0.10, closed=False, tolerance=0.01, dwell=0.3),
    )


TASKS = {"Lift": lift_waypoints, "Stack": stack_waypoints}


class Policy(Protocol):
    """A policy: joint velocities from the state, waypoint by waypoint."""

    done: bool
    waypoint: Waypoint
    """The current waypoint."""

    def nominal(self, now: float, q: Array, tool: ToolState, cubes: Mapping[str, Pose]) -> Array:
        """Joint velocities (n,) [rad/s] at time `now` [s]."""
        ...


class WaypointPolicy:
    """Waypoints in their order, each relative to the cubes at its start."""

    def __init__(
        self, points: Sequence[Waypoint], profile: SpeedProfile, max_speed: Array, posture: Array, period: float
    ) -> None:
        self.done, self.waypoint = False, points[0]
        self._remaining = list(points[1:])
        self._controller = ResolvedRateController(profile, max_speed, posture, period)
        self._goal: tuple[Array, Array] | None = None
        self._rotation: Array | None = None
        self._start, self._reached = 0.0, float("inf")

    def nominal(self, now: float, q: Array, tool: ToolState, cubes: Mapping[str, Pose]) -> Array:
        """Joint velocities toward the current waypoint; the next one follows after its dwell time or its time limit."""
        if self._goal is not None and self._is_over(now, tool):
            self.done = not self._remaining
            self.waypoint = self._remaining.pop(0) if self._remaining else self.waypoint
            self._goal = None if not self.done else self._goal
        if self._goal is None:
            self._goal, self._start, self._reached = self._target_pose(tool, cubes), now, float("inf")
        return self._controller.joint_velocity(tool, q, *self._goal)

    def _is_over(self, now: float, tool: ToolState) -> bool:
        assert self._goal is not None
        near = float(np.linalg.norm(self._goal[0] - tool.position)) <= self.waypoint.tolerance
        self._reached = min(self._reached, now) if near or self._reached < now else self._reached
        return now - self._reached >= self.waypoint.dwell or now - self._start > WAYPOINT_TIMEOUT_S

    def _target_pose(self, tool: ToolState, cubes: Mapping[str, Pose]) -> tuple[Array, Array]:
        """Position and rotation of the tool at the current waypoint."""
        point = self.waypoint
        position = np.array(cubes[point.target_cube].position) + np.array([0.0, 0.0, point.height])
        if point.carried_cube:
            position[:2] += (tool.position - np.array(cubes[point.carried_cube].position))[:2]
        if self._rotation is None:
            self._rotation = grasp_rotation(tool.rotation, cubes[point.target_cube])
        return position, self._rotation


def grasp_rotation(rotation: Array, cube: Pose) -> Array:
    """The tool pointing down, its fingers across two sides of `cube`: of the four rotations the nearest one."""
    side, now = quaternion_to_matrix(cube.quaternion)[:, 0], rotation[:, 0]
    turn = np.arctan2(side[1], side[0]) - np.arctan2(now[1], now[0])
    heading = np.arctan2(now[1], now[0]) + (turn + pi / 4) % (pi / 2) - pi / 4
    x, z = np.array([np.cos(heading), np.sin(heading), 0.0]), np.array([0.0, 0.0, -1.0])
    return np.column_stack([x, np.cross(z, x), z])


class BangBangPolicy:
    """Every joint at full speed in a random direction, changed after 0.15 to 1 s, without a task, fingers open."""

    def __init__(self, max_speed: Array, cube: str, seed: int, duration_s: float) -> None:
        self.done = False
        self.waypoint = Waypoint(name="anywhere", target_cube=cube, height=0.0, closed=False, tolerance=0.0)
        self._rng, self._max_speed, self._duration = np.random.default_rng(seed), max_speed, duration_s
        self._until, self._u = 0.0, np.zeros(len(max_speed))

    def nominal(self, now: float, q: Array, tool: ToolState, cubes: Mapping[str, Pose]) -> Array:
        """Joint velocities at full speed."""
        del q, tool, cubes
        if now >= self._until:
            self._u = np.where(self._rng.random(len(self._max_speed)) < 0.5, -1.0, 1.0) * self._max_speed
            self._until = now + float(self._rng.uniform(0.15, 1.0))
        self.done = now >= self._duration
        return self._u


SPEED_PROFILES = {"careful": CAREFUL, "hasty": HASTY}
