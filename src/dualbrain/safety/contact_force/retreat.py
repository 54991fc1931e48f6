"""Retreat from a contact: the arm yields to the force, of an unexpected contact until it is gone and the arm stops.

    u = r v_r ‖F‖/‖r‖²       r: external torque, F: contact force, v_r: `SPEED`

By F·(J u) = r·u the point of contact moves with the speed v_r along F. The control goes through the filter, so that a
retreat keeps every other distance. An arm that an obstacle stops is slower than its command, and its drive pushes. The
acceleration limits hold for motions, so they count from the velocity that is measured where the contact has changed it:

    u_prev,j ← v_j    for every joint j with r_j (u_prev,j − v_j) < 0
"""

from __future__ import annotations

import numpy as np

from dualbrain.robots.interface import Array, RobotState
from dualbrain.safety.contact_force.monitor import ContactForceMonitor

SPEED = 0.1
"""Speed v_r of the point of contact [m/s]."""
RELEASE_FORCE = 5.0
"""Force [N] below which a retreat ends, if the error of the estimate is not larger."""
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

    def update(self, state: RobotState, *, wanted: bool) -> None:
        """Begin, continue or end at the measured state. `wanted`: the check has tripped."""
        if not wanted:
            self._first_stamp, self.active = None, False
            return
        if self._first_stamp is None:
            self._first_stamp = state.stamp
        if self._monitor.force is None or state.stamp - self._first_stamp >= MAX_TIME:
            self.active = False
        elif self.active:
            brief = state.stamp - self._began < MIN_TIME
            force = self._monitor.force
            self.active = brief or force.magnitude >= max(RELEASE_FORCE, force.uncertainty)
        elif self._monitor.is_exceeded:
            self._began, self.active = state.stamp, True

    def yielding_control(self, state: RobotState, u: Array) -> Array:
        """The last control `u` (n,) with the measured velocity for every joint in which `u` pushes more [rad/s]."""
        pushes = (u - state.v) * self._torque(len(u)) < 0.0
        return np.where(pushes, state.v, u)

    def control(self, n: int) -> Array:
        """The nominal control (n,) [rad/s] of the retreat."""
        force, torque = self._monitor.force, self._torque(n)
        size = float(torque @ torque)
        return torque * (SPEED * force.magnitude / size if force is not None and size > 0.0 else 0.0)

    def _torque(self, n: int) -> Array:
        """The external torque (n,) [Nm], 0 for the joints of a base and without an estimate."""
        torque, found = np.zeros(n), self._monitor.joint_torque
        if found is not None:
            torque[n - len(found) :] = found
        return torque
