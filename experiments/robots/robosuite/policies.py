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

from dualbrain.core.geometry.rotations import matrix
from dualbrain.core.geometry.shapes import Pose
from dualbrain.safety.cbf.filter import ToolState
from experiments.robots.robosuite.resolved_rate import CAREFUL, HASTY, Pace, Reach

Array = NDArray[np.float64]

GRASP = 0.0
"""Height of the tool over the cube's middle when it takes it [m]; the pads of the suite's fingers sit 1 cm higher."""
ON_TOP = 0.045
"""Between the middles of a cube of 4 cm and of the one of 5 cm that it stands on [m]."""
PATIENCE = 10.0
"""After this the next way point is taken, reached or not [s]: long, as a filtered arm may be much slower."""


@dataclass(frozen=True, slots=True)
class WayPoint:
    """Where the tool goes next: `height` [m] over the middle of the cube `over`, as that stands when the way begins.

    With `closed` fingers; done when within `near` [m], and then `dwell` [s] later. `carries` names the cube that is to
    come there instead of the tool. `touching` the cube may be set down.
    """

    name: str
    over: str
    height: float
    closed: bool
    near: float
    dwell: float = 0.0
    carries: str = ""
    touching: str = ""


def lift(hasty: bool) -> tuple[WayPoint, ...]:
    """Take the cube and lift it."""
    if hasty:
        return (
            WayPoint("over", "cube", 0.03, False, 0.02),
            WayPoint("down", "cube", GRASP, False, 0.01),
            WayPoint("close", "cube", GRASP, True, 0.02, 0.25),
            WayPoint("up", "cube", 0.12, True, 0.02, 0.2),
        )
    return (
        WayPoint("over", "cube", 0.10, False, 0.01),
        WayPoint("down", "cube", GRASP, False, 0.003),
        WayPoint("close", "cube", GRASP, True, 0.01, 0.4),
        WayPoint("up", "cube", 0.12, True, 0.01, 0.3),
    )


def stack(hasty: bool) -> tuple[WayPoint, ...]:
    """Take one cube and put it on the other; the hasty way leads straight there, past the other's corner."""
    put = ON_TOP + GRASP
    if hasty:
        return (
            WayPoint("over", "cubeA", 0.03, False, 0.02),
            WayPoint("down", "cubeA", GRASP, False, 0.01),
            WayPoint("close", "cubeA", GRASP, True, 0.02, 0.25),
            WayPoint("across", "cubeB", put + 0.01, True, 0.02, carries="cubeA"),
            WayPoint("lower", "cubeB", put + 0.002, True, 0.005, carries="cubeA", touching="cubeB"),
            WayPoint("open", "cubeB", put + 0.002, False, 0.02, 0.25, carries="cubeA", touching="cubeB"),
            WayPoint("away", "cubeB", put + 0.10, False, 0.03, 0.1),
        )
    return (
        WayPoint("over", "cubeA", 0.10, False, 0.01),
        WayPoint("down", "cubeA", GRASP, False, 0.003),
        WayPoint("close", "cubeA", GRASP, True, 0.01, 0.4),
        WayPoint("up", "cubeA", 0.12, True, 0.01),
        WayPoint("across", "cubeB", put + 0.06, True, 0.005, carries="cubeA"),
        WayPoint("lower", "cubeB", put + 0.002, True, 0.003, 0.2, carries="cubeA", touching="cubeB"),
        WayPoint("open", "cubeB", put + 0.002, False, 0.01, 0.5, carries="cubeA", touching="cubeB"),
        WayPoint("away", "cubeB", put + 0.10, False, 0.01, 0.3),
    )


TASKS = {"Lift": lift, "Stack": stack}


class Policy(Protocol):
    """What is flown: joint velocities from the state, way point by way point."""

    done: bool
    point: WayPoint
    """The way point it is at."""

    def wish(self, now: float, q: Array, tool: ToolState, cubes: Mapping[str, Pose]) -> Array:
        """Joint velocities (n,) [rad/s] at time `now` [s]."""
        ...


class Script:
    """Way points in their order, each from where the cubes are when it begins."""

    def __init__(self, points: Sequence[WayPoint], pace: Pace, fastest: Array, posture: Array, period: float) -> None:
        self.done, self.point = False, points[0]
        self._left = list(points[1:])
        self._reach = Reach(pace, fastest, posture, period)
        self._goal: tuple[Array, Array] | None = None
        self._rotation: Array | None = None
        self._began, self._reached = 0.0, float("inf")

    def wish(self, now: float, q: Array, tool: ToolState, cubes: Mapping[str, Pose]) -> Array:
        """Toward the present way point; on to the next when it is reached for long enough, or takes too long."""
        if self._goal is not None and self._is_over(now, tool):
            self.done = not self._left
            self.point = self._left.pop(0) if self._left else self.point
            self._goal = None if not self.done else self._goal
        if self._goal is None:
            self._goal, self._began, self._reached = self._aim(tool, cubes), now, float("inf")
        return self._reach.toward(tool, q, *self._goal)

    def _is_over(self, now: float, tool: ToolState) -> bool:
        assert self._goal is not None
        near = float(np.linalg.norm(self._goal[0] - tool.position)) <= self.point.near
        self._reached = min(self._reached, now) if near or self._reached < now else self._reached
        return now - self._reached >= self.point.dwell or now - self._began > PATIENCE

    def _aim(self, tool: ToolState, cubes: Mapping[str, Pose]) -> tuple[Array, Array]:
        """Position and rotation of the tool at the present way point."""
        point = self.point
        position = np.array(cubes[point.over].position) + np.array([0.0, 0.0, point.height])
        if point.carries:
            position[:2] += (tool.position - np.array(cubes[point.carries].position))[:2]
        if self._rotation is None:
            self._rotation = across(tool.rotation, cubes[point.over])
        return position, self._rotation


def across(rotation: Array, cube: Pose) -> Array:
    """The tool pointing down, its fingers across two sides of `cube`: of the four ways the one that turns least."""
    side, now = matrix(cube.quaternion)[:, 0], rotation[:, 0]
    turn = np.arctan2(side[1], side[0]) - np.arctan2(now[1], now[0])
    heading = np.arctan2(now[1], now[0]) + (turn + pi / 4) % (pi / 2) - pi / 4
    x, z = np.array([np.cos(heading), np.sin(heading), 0.0]), np.array([0.0, 0.0, -1.0])
    return np.column_stack([x, np.cross(z, x), z])


class BangBang:
    """Every joint at full speed either way, changed after 0.15 to 1 s: no task, fingers open."""

    def __init__(self, fastest: Array, cube: str, seed: int, lasts: float) -> None:
        self.done, self.point = False, WayPoint("anywhere", cube, 0.0, False, 0.0)
        self._rng, self._fastest, self._lasts = np.random.default_rng(seed), fastest, lasts
        self._until, self._u = 0.0, np.zeros(len(fastest))

    def wish(self, now: float, q: Array, tool: ToolState, cubes: Mapping[str, Pose]) -> Array:
        """Full speed."""
        del q, tool, cubes
        if now >= self._until:
            self._u = np.where(self._rng.random(len(self._fastest)) < 0.5, -1.0, 1.0) * self._fastest
            self._until = now + float(self._rng.uniform(0.15, 1.0))
        self.done = now >= self._lasts
        return self._u


PACES = {"careful": CAREFUL, "hasty": HASTY}
