"""Policies for robosuite's OSC_POSE: scripts for three tasks, careful and careless, and random actions.

A script is a list of waypoints of the gripper. The careful one keeps above all objects, moves at half the
range of the actions, and waits at a waypoint until it is there. The careless one has five times the gain and the full
range, goes from one place to the next in a straight line, low, and leaves a waypoint 3 cm before it.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STEP, TURN = 0.05, 0.5
"""The change of the pose that an action of 1 asks for [m], [rad] (robosuite's default)."""
PATIENCE = 160
"""Policy steps after which a script goes on to the next waypoint: 8 s, because a guarded arm is slower."""
RANDOM_STEPS, HOLD_STEPS = 120, 12
"""Length of a random episode, and of one random action, in policy steps."""
NEARER = np.array([0.06, 0.06, 0.0])
"""From the centre of the can's part of the bin toward the robot [m]: the arm cannot reach that centre from above."""
OPEN, CLOSE = -1.0, 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Waypoint:
    """The gripper at `position` (3,) [m], with its command; left within `tolerance` [m], `dwell` policy steps later."""

    position: Array
    gripper: float
    tolerance: float
    dwell: int = 0


def waypoints(env: Any, task: str, careless: bool) -> list[Waypoint]:
    """The script of `task` for the present positions of its objects."""
    near, exact = (0.03, 0.015) if careless else (0.012, 0.005)
    low, high = (0.02, 0.02) if careless else (0.10, 0.12)
    thing = _position(env, {"Lift": "cube_main", "Stack": "cubeA_main", "PickPlaceCan": "Can_main"}[task])

    def at(place: Array, height: float, gripper: float, tolerance: float, dwell: int = 0) -> Waypoint:
        position = place + np.array([0.0, 0.0, height])
        return Waypoint(position=position, gripper=gripper, tolerance=tolerance, dwell=dwell)

    grasp = 0.02 if task == "PickPlaceCan" else 0.0
    points = [at(thing, grasp + low, OPEN, near), at(thing, grasp, OPEN, exact), at(thing, grasp, CLOSE, near, 10)]
    if task == "Lift":
        return [*points, at(thing, 0.12, CLOSE, near, 5)]
    if task == "Stack":
        goal, put = _position(env, "cubeB_main"), 0.047
    else:
        goal, put = np.array(env.target_bin_placements[env.object_id]) - NEARER, grasp + 0.08
        goal[2], high = thing[2], 0.02 if careless else 0.22
    lift = [] if careless else [at(thing, high + grasp, CLOSE, near), at(goal, put + high, CLOSE, exact, 5)]
    away = at(goal, put + 0.15, OPEN, near, 5)
    return [*points, *lift, at(goal, put, CLOSE, exact, 0 if careless else 5), at(goal, put, OPEN, near, 8), away]


class ScriptedPolicy:
    """Actions toward one waypoint after the other."""

    def __init__(self, env: Any, task: str, careless: bool) -> None:
        self._env, self._points = env, waypoints(env, task, careless)
        self._gain, self._bound = (1.0, 1.0) if careless else (0.2, 0.5)
        self._rotation = _grasp_rotation(env, task)
        self._steps = self._near = 0
        self.done = False

    def __call__(self) -> Array:
        """The next action (7,)."""
        point, site = self._points[0], _gripper(self._env)
        error = point.position - site[0]
        self._steps, self._near = self._steps + 1, self._near + (np.linalg.norm(error) < point.tolerance)
        if self._near > point.dwell or self._steps > PATIENCE:
            self._steps = self._near = 0
            self.done = len(self._points) == 1
            self._points = self._points[1:] or self._points
        turn = 0.5 * sum(np.cross(site[1][:, k], self._rotation[:, k]) for k in range(3))
        motion = np.concatenate([error / STEP, turn / TURN]) * self._gain * 5.0
        return np.append(np.clip(motion, -self._bound, self._bound), point.gripper)


class RandomPolicy:
    """Every entry at the end of its range, for 0.6 s each; every second action goes down."""

    def __init__(self, seed: int) -> None:
        self._rng, self._count, self._action = np.random.default_rng(seed), 0, np.zeros(7)
        self.done = False

    def __call__(self) -> Array:
        """The next action (7,)."""
        if self._count % HOLD_STEPS == 0:
            self._action = self._rng.choice([-1.0, 1.0], 7)
            if self._count % (2 * HOLD_STEPS) == 0:
                self._action[2] = -1.0
        self._count += 1
        self.done = self._count >= RANDOM_STEPS
        return self._action


def _position(env: Any, body: str) -> Array:
    return np.array(env.sim.data._data.body(body).xpos)


def _gripper(env: Any) -> tuple[Array, Array]:
    """Position (3,) [m] and rotation (3, 3) of robosuite's grip site."""
    data, site = env.sim.data._data, env.robots[0].eef_site_id["right"]
    return np.array(data.site_xpos[site]), np.array(data.site_xmat[site]).reshape(3, 3)


def _grasp_rotation(env: Any, task: str) -> Array:
    """The gripper pointing down, its fingers across two sides of the cube, of four rotations the nearest one."""
    now = _gripper(env)[1][:, 0]
    heading = np.arctan2(now[1], now[0])
    if task != "PickPlaceCan":
        side = env.sim.data._data.body("cube_main" if task == "Lift" else "cubeA_main").xmat.reshape(3, 3)[:, 0]
        turn = np.arctan2(side[1], side[0]) - heading
        heading += (turn + pi / 4) % (pi / 2) - pi / 4
    x, z = np.array([np.cos(heading), np.sin(heading), 0.0]), np.array([0.0, 0.0, -1.0])
    return np.column_stack([x, np.cross(z, x), z])
