"""Retreat from an unexpected contact: the arm yields to the force until it is gone, then it stops.

    u = r v_r ‖F‖/‖r‖²       r: external torque, F: contact force, v_r: `SPEED`

By F·(J u) = r·u the point of contact moves with the speed v_r along F. The control goes through the filter, so that a
retreat keeps every other distance. The drive of an arm that is stopped by an obstacle still pushes toward its last
command, so the filter's last control is set to the measured velocity when the retreat begins.
"""

from __future__ import annotations

import numpy as np

from dualbrain.robots.interface import Array, RobotState
from dualbrain.safety.contact_force.monitor import ContactForceMonitor

SPEED = 0.1
"""Speed v_r of the point of contact [m/s]."""
RELEASE_FORCE = 5.0
"""Force [N] below which a retreat ends, above the error of the estimate at the packaged robots' home."""
MIN_TIME, MAX_TIME = 0.03, 0.3
"""Shortest duration of a retreat, and the time after the first contact in which the arm may retreat [s]."""


class Retreat:
    """The retreat of one robot; `active` while it lasts. An arm between two obstacles may retreat more than once."""

    def __init__(self, monitor: ContactForceMonitor) -> None:
        """Yield to the force that `monitor` estimates."""
        self._monitor = monitor
        self._first_stamp: float | None = None
        self._began = 0.0
        self.active = False

    def update(self, state: RobotState, *, wanted: bool) -> bool:
        """Begin, continue or end at the measured state; whether a retreat begins. `wanted`: the check has tripped."""
        if not wanted:
            self._first_stamp, self.active = None, False
            return False
        if self._first_stamp is None:
            self._first_stamp = state.stamp
        if self._monitor.force is None or state.stamp - self._first_stamp >= MAX_TIME:
            self.active = False
            return False
        if self.active:
            brief = state.stamp - self._began < MIN_TIME
            self.active = brief or self._monitor.force.magnitude >= RELEASE_FORCE
            return False
        if not self._monitor.is_exceeded:
            return False
        self._began, self.active = state.stamp, True
        return True

    def control(self, n: int) -> Array:
        """The nominal control (n,) [rad/s] of the retreat."""
        force, torque = self._monitor.force, self._monitor.external_torque.residual
        u = np.zeros(n)
        if force is not None and torque is not None:
            torque = self._monitor.joint_torque(torque)
            size = float(torque @ torque)
            u[n - len(torque) :] = torque * (SPEED * force.magnitude / size if size > 0.0 else 0.0)
        return u
