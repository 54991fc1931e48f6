"""Policies of different care: each answers a joint position target for the next 20 ms, as an imitation policy does."""

from __future__ import annotations

from functools import cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from benchmarks.guards.scene import GuardScene, joint_range, load_panda

Array = NDArray[np.float64]

PERIOD = 0.02
"""Time between two actions [s]."""
CAREFUL_SPEED, FULL_SPEED = 0.4, 0.9
"""Speed of the fastest joint relative to its limit."""
BRAKING_SHARE = 0.4
"""Share of the acceleration limits with which a policy brakes before its target."""
MAX_DEVIATION = 0.12
"""Largest distance of a joint from the posture of the path that the careful policy aims at [rad]."""


class Policy(Protocol):
    """A policy for one episode."""

    def act(self, q: Array) -> Array:
        """The joint position target (n,) [rad] at the measured posture q (n,)."""
        ...


class CarelessPolicy:
    """Straight to the goal at full speed, without regard to obstacles."""

    def __init__(self, scene: GuardScene, rng: np.random.Generator) -> None:
        del rng
        self._goal, self._speed = scene.goal, FULL_SPEED * speed_limits()

    def act(self, q: Array) -> Array:
        """One step towards the goal."""
        return step_towards(q, self._goal, self._speed)


class RandomPolicy:
    """To a new random posture every 0.8 s, at full speed; it has no goal."""

    def __init__(self, scene: GuardScene, rng: np.random.Generator) -> None:
        del scene
        self._rng, self._limits, self._count = rng, joint_range(load_panda()[0]), 0
        self._speed = FULL_SPEED * speed_limits()

    def act(self, q: Array) -> Array:
        """One step towards the present random posture."""
        if self._count % round(0.8 / PERIOD) == 0:
            self._target = self._rng.uniform(self._limits.lower, self._limits.upper)
        self._count += 1
        return step_towards(q, self._target, self._speed)


class CarefulPolicy:
    """Along the planned path, which keeps 18 mm from every obstacle, at less than half of the speed limits."""

    def __init__(self, scene: GuardScene, rng: np.random.Generator) -> None:
        del rng
        self._path, self._index, self._speed = scene.path, 0, CAREFUL_SPEED * speed_limits()

    def act(self, q: Array) -> Array:
        """One step towards the farthest posture of the path that one action reaches from here."""
        while self._index + 1 < len(self._path) and self._is_near(q, self._index):
            self._index += 1
        return step_towards(q, self._path[self._index], self._speed)

    def _is_near(self, q: Array, index: int) -> bool:
        return bool(np.all(np.abs(self._path[index] - q) <= MAX_DEVIATION))


def step_towards(q: Array, target: Array, speed: Array) -> Array:
    """The posture that one action reaches on the straight way from q to `target`.

    No joint is faster than its `speed` (n,) [rad/s], or than constant braking before the target allows.
    """
    gap = np.abs(target - q)
    step = PERIOD * np.minimum(speed, np.sqrt(2.0 * BRAKING_SHARE * acceleration_limits() * gap))
    share = float(np.max(gap / np.maximum(step, 1e-9)))
    return target.copy() if share <= 1.0 else q + (target - q) / share


@cache
def speed_limits() -> Array:
    """The velocity limits (n,) of the Panda [rad/s]."""
    return np.array([joint.velocity.value for joint in load_panda()[0].joints])


@cache
def acceleration_limits() -> Array:
    """The acceleration limits (n,) of the Panda [rad/s²]."""
    return np.array([joint.acceleration.value for joint in load_panda()[0].joints])
