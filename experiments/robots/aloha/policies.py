"""Policies of gym-aloha's transfer of the cube: careful and careless waypoints of both arms, and random targets.

The right hand grasps the cube from above, and the left hand takes it out of the right one in the middle. The careful
policy lifts the cube before it moves on, is slow, and rests at every waypoint. The careless one moves five times faster
in straight lines of the joints, sends the left hand ahead to the place of the handover, and lifts nothing first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from experiments.robots.aloha.inverse_kinematics import START, InverseKinematics

Array = NDArray[np.float64]

STEP_TIME = 0.02
OPEN, CLOSED = 1.0, 0.0
"""Entries of the grippers."""
CAREFUL_SPEED, CARELESS_SPEED = 0.4, 2.0
"""Joint speed [rad/s]."""
REACHED, PATIENCE, CAREFUL_REST, CARELESS_REST = 0.06, 4.0, 0.6, 0.1
"""Error of a joint at which a waypoint counts as reached [rad], the longest wait for it, and the rest at it [s]."""
GRASP_HEIGHT, ABOVE, MEETING = 0.02, np.array([0.0, 0.0, 0.12]), np.array([0.0, 0.5, 0.25])
"""Height of the grasp, the waypoint above it from there, and the place of the handover [m]."""
AWAY = np.array([-0.14, 0.0, 0.0])
"""Place of the left hand before it takes the cube, from the handover [m]."""
DOWN_START = np.array([0.0, 0.2, 0.4, 0.0, 0.9, 0.0])
"""Posture from which a grasp from above is searched [rad]."""
RANDOM_LOW = np.array([-0.6, -0.6, -1.0, -1.5, -1.0, -1.5])
RANDOM_HIGH = np.array([0.6, 1.1, 1.3, 1.5, 1.5, 1.5])
RANDOM_HOLD = 25
"""Range of the joints of a random policy [rad], and steps for which it holds a target."""


class Policy(Protocol):
    """A policy that knows the joint positions of both arms."""

    def action(self, q: dict[str, Array]) -> Array:
        """The action (14,) for the joint positions `q` (6,) [rad] of each side."""
        ...


@dataclass(frozen=True, slots=True)
class Waypoint:
    """Joint positions (6,) [rad] and gripper entry of both arms."""

    left: Array
    left_gripper: float
    right: Array
    right_gripper: float


class WaypointPolicy:
    """Moves along straight lines in the joints at `speed` [rad/s], and rests for `rest` [s] at every waypoint."""

    def __init__(self, waypoints: list[Waypoint], speed: float, rest: float) -> None:
        self._waypoints, self._speed, self._rest = waypoints, speed, rest
        self._target = np.concatenate([START, START])
        self._index, self._waited, self._rested = 0, 0.0, 0.0

    @property
    def waypoint(self) -> Waypoint:
        """The present waypoint; the last one is held."""
        return self._waypoints[min(self._index, len(self._waypoints) - 1)]

    def action(self, q: dict[str, Array]) -> Array:
        """The next commanded positions on the way to the waypoint."""
        point = self.waypoint
        goal = np.concatenate([point.left, point.right])
        way = goal - self._target
        share = min(1.0, self._speed * STEP_TIME / max(1e-9, float(np.abs(way).max())))
        self._target = self._target + share * way
        if share == 1.0:
            self._advance(float(np.abs(np.concatenate([q["left"], q["right"]]) - goal).max()))
        return np.array([*self._target[:6], point.left_gripper, *self._target[6:], point.right_gripper])

    def _advance(self, error: float) -> None:
        self._waited += STEP_TIME
        self._rested += STEP_TIME if error < REACHED else 0.0
        if self._rested >= self._rest or self._waited > PATIENCE:
            self._index, self._waited, self._rested = self._index + 1, 0.0, 0.0


class RandomPolicy:
    """Random joint positions of both arms above the table and in the middle, and random grippers, held for 0.5 s."""

    def __init__(self, seed: int) -> None:
        self._rng, self._step, self._held = np.random.default_rng(seed), 0, np.zeros(14)

    def action(self, q: dict[str, Array]) -> Array:
        """The target that is held."""
        del q
        if self._step % RANDOM_HOLD == 0:
            arms = [np.append(self._rng.uniform(RANDOM_LOW, RANDOM_HIGH), self._rng.random()) for _ in range(2)]
            self._held = np.concatenate(arms)
        self._step += 1
        return self._held


def transfer_policy(model: Any, cube: Array, *, careful: bool) -> WaypointPolicy:
    """The transfer of a cube at `cube` (3,) [m], in the MuJoCo model of the environment."""
    right, left = InverseKinematics(model, "right"), InverseKinematics(model, "left")
    down, inward = _frame([0, 0, -1], [0, -1, 0]), _frame([-1, 0, 0], [0, -1, 0])
    outward = _frame([1, 0, 0], [0, 0, 1])
    start = DOWN_START.copy()
    start[0] = start[5] = np.arctan2(0.5 - cube[1], 0.469 - cube[0])
    at = np.array([cube[0], cube[1], GRASP_HEIGHT])
    grasp = right.solve(at, down, start)
    above = right.solve(at + ABOVE, down, grasp)
    handover = right.solve(MEETING, inward)
    ready, taken = (left.solve(MEETING + offset, outward) for offset in (AWAY, np.zeros(3)))
    careful_points = [
        Waypoint(START, OPEN, above, OPEN),
        Waypoint(START, OPEN, grasp, OPEN),
        Waypoint(START, OPEN, grasp, CLOSED),
        Waypoint(START, OPEN, above, CLOSED),
        Waypoint(ready, OPEN, handover, CLOSED),
        Waypoint(taken, OPEN, handover, CLOSED),
        Waypoint(taken, CLOSED, handover, CLOSED),
        Waypoint(taken, CLOSED, handover, OPEN),
        Waypoint(ready, CLOSED, above, OPEN),
    ]
    if careful:
        return WaypointPolicy(careful_points, CAREFUL_SPEED, CAREFUL_REST)
    hasty_points = [
        Waypoint(taken, OPEN, grasp, OPEN),
        Waypoint(taken, OPEN, grasp, CLOSED),
        Waypoint(taken, OPEN, handover, CLOSED),
        Waypoint(taken, CLOSED, handover, CLOSED),
        Waypoint(taken, CLOSED, handover, OPEN),
    ]
    return WaypointPolicy(hasty_points, CARELESS_SPEED, CARELESS_REST)


def _frame(approach: list[float], fingers: list[float]) -> Array:
    """Rotation of a gripper with its fingers along `approach`, opening along `fingers`."""
    x, y = np.array(approach, float), np.array(fingers, float)
    return np.stack([x, y, np.cross(x, y)], axis=1)
