"""Policies of displacements: careful scripts, straight to the goal at full speed, low, and random."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Places = dict[str, Array]
"""`tool`, `object` and `goal` (3,) [m]."""

GAIN = 6.0
"""Entry of an action per metre of error, of a careful policy of Fetch."""
ABOVE = np.array([0.0, 0.0, 0.10])
REACHED = 0.012
"""Error at which a waypoint counts as reached [m]."""
BEHIND = 0.09
"""Distance of the tool from the object before a push [m]."""
PUSH_HEIGHT, GRASP_HEIGHT = 0.025, 0.012
"""Height of the tool above the centre of the object [m]: the fingers reach 1.8 cm below it."""
PATIENCE, CLOSE_STEPS = 60, 12
"""Steps after which a script goes on without having reached its waypoint, and steps of closing the gripper."""
RANDOM_HOLD = 12
"""Steps for which a random action is held; every second one goes down."""
OPEN, CLOSED = 1.0, -1.0


class Policy(Protocol):
    """A policy that knows where things are."""

    def __call__(self, places: Places, observation: Any) -> Array:
        """The action (4,): displacement and gripper."""
        ...


class Low:
    """Downwards at full speed, and at the same time toward the goal in the plane."""

    def __call__(self, places: Places, observation: Any) -> Array:
        """The action."""
        del observation
        way = (places["goal"] - places["tool"])[:2]
        return np.array([*way / max(1e-6, float(np.abs(way).max())), -1.0, 0.0])


class Straight:
    """Straight at the object, or at the goal if there is none, at full speed, and then to the goal."""

    def __init__(self, has_object: bool) -> None:
        self._toward_object = has_object

    def __call__(self, places: Places, observation: Any) -> Array:
        """The action."""
        del observation
        error = places["object" if self._toward_object else "goal"] - places["tool"]
        if self._toward_object and np.linalg.norm(error) < 2.0 * REACHED:
            self._toward_object = False
        return np.append(error / max(1e-6, float(np.abs(error).max())), 0.0)


class RandomPolicy:
    """Every entry at an end of its range, held for `RANDOM_HOLD` steps."""

    def __init__(self, seed: int) -> None:
        self._rng, self._count, self._action = np.random.default_rng(seed), 0, np.zeros(4)

    def __call__(self, places: Places, observation: Any) -> Array:
        """The action."""
        del places, observation
        if self._count % RANDOM_HOLD == 0:
            self._action = self._rng.choice([-1.0, 1.0], 4)
            if self._count % (2 * RANDOM_HOLD) == 0:
                self._action[2] = -1.0
        self._count += 1
        return self._action


class MetaworldExpert:
    """The scripted policy that metaworld provides, clipped to the range of the actions."""

    def __init__(self, expert: Any) -> None:
        self._expert = expert

    def __call__(self, places: Places, observation: Any) -> Array:
        """The action."""
        del places
        return np.clip(np.asarray(self._expert.get_action(observation), float), -1.0, 1.0)


class FetchScript:
    """Proportional control: to the goal; behind the object and along to the goal; or to a grasp and to the goal."""

    def __init__(self, task: str) -> None:
        self._task, self._phase, self._count = task, 0, 0

    def __call__(self, places: Places, observation: Any) -> Array:
        """The action."""
        del observation
        tool, thing, goal = places["tool"], places["object"], places["goal"]
        if self._task == "FetchReach":
            return _toward(goal, tool, 0.0)
        return self._push(tool, thing, goal) if self._task == "FetchPush" else self._grasp(tool, thing, goal)

    def _push(self, tool: Array, thing: Array, goal: Array) -> Array:
        way = (goal - thing)[:2]
        direction = np.append(way / max(1e-6, float(np.linalg.norm(way))), 0.0)
        height = np.array([0.0, 0.0, PUSH_HEIGHT])
        points = (thing - BEHIND * direction + ABOVE, thing - BEHIND * direction + height)
        if self._phase < len(points):
            self._advance(points[self._phase], tool)
            return _toward(points[min(self._phase, 1)], tool, CLOSED)
        across = (thing - tool)[:2] - direction[:2] * float((thing - tool)[:2] @ direction[:2])
        if np.linalg.norm(across) > 0.03 and np.linalg.norm(way) > 0.05:
            self._phase = 0
        target = goal - 0.5 * BEHIND * direction + height
        target[2] = thing[2] + PUSH_HEIGHT
        return _toward(target, tool, CLOSED, 0.5)

    def _grasp(self, tool: Array, thing: Array, goal: Array) -> Array:
        grasp = thing + np.array([0.0, 0.0, GRASP_HEIGHT])
        if self._phase == 0:
            self._advance(thing + ABOVE, tool)
            return _toward(thing + ABOVE, tool, OPEN)
        if self._phase == 1:
            self._advance(grasp, tool)
            return _toward(grasp, tool, OPEN)
        self._count += 1
        if self._count < CLOSE_STEPS:
            return np.array([0.0, 0.0, 0.0, CLOSED])
        return _toward(goal + tool - thing, tool, CLOSED)

    def _advance(self, point: Array, tool: Array) -> None:
        """The next phase at the waypoint, or after waiting for the guarded tool to come nearer."""
        self._count += 1
        if np.linalg.norm(point - tool) < REACHED or self._count > PATIENCE:
            self._phase, self._count = self._phase + 1, 0


def _toward(point: Array, tool: Array, gripper: float, bound: float = 1.0) -> Array:
    return np.append(np.clip(GAIN * (point - tool), -bound, bound), gripper)


def make_policy(policy: str, task: str, seed: int, expert: Any) -> Policy:
    """The policy: "careful", "straight", "low" or "random"."""
    if policy == "low":
        return Low()
    if policy == "straight":
        return Straight(has_object=task in ("FetchPush", "FetchPickAndPlace", "push-v3", "pick-place-v3"))
    if policy == "random":
        return RandomPolicy(seed)
    return FetchScript(task) if expert is None else MetaworldExpert(expert)
