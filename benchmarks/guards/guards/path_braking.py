"""Braking along the path of the policy, as PACS (arXiv 2511.06385) does, implemented here from its idea.

Every 4 ms the guard predicts the commanded motion and, after it, the hardest stop along it. It is executed if the whole
arm stays clear in every predicted posture; otherwise the stop that was verified before is carried out. The path is
never left, so that a policy stays within what it was trained on.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from benchmarks.guards.robot_interface import RobotInterface

Array = NDArray[np.float64]
IsClear = Callable[[Array], NDArray[np.bool_]]
"""Whether the whole arm is clear at each of the postures (t, n)."""

VERIFIED_PERIOD = 0.004
"""Time between two verifications [s]."""
RESOLUTION = 0.02
"""Distance between two verified postures [rad]."""
CLEARANCE = (0.004, 0.002, 0.005)
"""Clearance of obstacles, own links [m] and joint limits [rad]: the motion between two postures, and the drive."""
BRAKING_SHARE = 0.9
"""Share of the acceleration limit with which a stop is predicted."""


class PathBraking:
    """Executes the commanded motion while a stop after it is verified to be clear."""

    def __init__(self, interface: RobotInterface, duration: float, is_clear: IsClear) -> None:
        """Command `interface`; an action lasts `duration` [s]."""
        self._interface, self._duration, self._arm_is_clear = interface, duration, is_clear
        self._towards, self._next = np.zeros_like(interface.u), 0.0
        self._verified, self._braking = np.zeros_like(interface.u), True

    def begin(self, action: Array, q: Array, now: float) -> None:
        """Take `action` as the target."""
        del q, now
        self._towards = self._interface.velocity_towards(action, self._duration)

    def velocity(self, q: Array, v: Array, now: float) -> Array:
        """The commanded velocity if it is verified, else the next one of the stop along the path."""
        del q, v
        if now >= self._next - 1e-9:
            self._next = now + VERIFIED_PERIOD
            wanted = self._wanted()
            self._braking = not self._is_clear(wanted)
            if not self._braking:
                self._verified = wanted
        return self._stop() if self._braking else self._verified

    def _wanted(self) -> Array:
        """The commanded velocity within what the joints reach in this time, along one direction."""
        interface = self._interface
        step = BRAKING_SHARE * interface.a_max * VERIFIED_PERIOD
        change = self._towards - interface.u
        share = float(np.min(np.where(np.abs(change) > step, step / np.maximum(np.abs(change), 1e-12), 1.0)))
        return interface.u + share * change

    def _stop(self) -> Array:
        """The next velocity of the hardest stop along the direction of motion."""
        interface = self._interface
        step = BRAKING_SHARE * interface.a_max * interface.period
        longest = float(np.max(np.abs(interface.u) / step))
        return interface.u * max(0.0, 1.0 - 1.0 / longest) if longest > 1.0 else np.zeros_like(interface.u)

    def _is_clear(self, u: Array) -> bool:
        """Whether all postures of `VERIFIED_PERIOD` at u and of the stop after it are clear."""
        interface = self._interface
        start = interface.commanded + VERIFIED_PERIOD * u
        duration = float(np.max(np.abs(u) / (BRAKING_SHARE * interface.a_max)))
        count = 2 + int(np.ceil(np.abs(u).max() * duration / 2.0 / RESOLUTION))
        share = np.linspace(0.0, 1.0, count)[:, None]
        stop = start + u * duration * (share - 0.5 * share**2)
        return bool(self._arm_is_clear(stop).all())
