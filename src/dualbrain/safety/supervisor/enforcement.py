"""Enforcement of decisions: scale the nominal control, monitor a standstill, and switch the drive off and on.

    u_nom' = s u_nom      with s = 1 (NONE, WARN), the speed stage (SLOW), 0 (HOVER and above), before the filter
    u      = 0            once a HOLD or CONTROLLED_STOP has come to rest; the joints are monitored from then on

The nominal control is scaled *before* the filter, so that nothing changes u after its certificate. The zero control of
a standstill is written only when the arm is already at rest.
"""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.interface import RobotState
from dualbrain.safety.supervisor.actions import SafetyAction, SupervisorDecision
from dualbrain.safety.supervisor.conditions import Condition

Array = NDArray[np.float64]

C = Condition


class StandstillLimits(msgspec.Struct, frozen=True, kw_only=True):
    """Limits of braking and standstill.

    - `rest_velocity` [rad/s]: below it the arm is at rest. `max_drift` [rad]: allowed motion in a standstill.
    - `stop_timeout` [s]: longest duration of braking.
    - `brake_time` [s]: time in which the brakes stop the arm. `max_brake_slip` [rad]: allowed motion beyond the
      distance that the arm would coast in that time.
    - `slow_scale`: scale of SLOW without a lower speed stage.
    """

    rest_velocity: float = 0.01
    max_drift: float = 0.01
    stop_timeout: float = 0.8
    brake_time: float = 0.4
    max_brake_slip: float = 0.03
    slow_scale: float = 0.5


class Enforcement:
    """State of a decision across ticks: when a stop began, where the arm stopped, and whether the drive is wanted."""

    def __init__(self, limits: StandstillLimits | None = None) -> None:
        """Start without an action and with the drive wanted."""
        self.limits = limits or StandstillLimits()
        self.drive_wanted = True
        self.standstill_q: Array | None = None
        self._stop_since: float | None = None
        self._drive_off_stamp: float | None = None
        self._drive_off_q = self._coast_limit = np.zeros(0)

    def scale(self, decision: SupervisorDecision, speed_scale: float) -> float:
        """Scale in [0, 1] of the nominal control; `speed_scale` is the speed that the operator has chosen."""
        if decision.action >= SafetyAction.HOVER:
            return 0.0
        if decision.action < SafetyAction.SLOW:
            return 1.0
        return speed_scale if decision.check == "speed_stage" else min(speed_scale, self.limits.slow_scale)

    @property
    def at_standstill(self) -> bool:
        """Whether u = 0 must be written: the arm is at rest under a HOLD or a CONTROLLED_STOP."""
        return self.standstill_q is not None

    def apply(self, decision: SupervisorDecision, state: RobotState, *, retreating: bool = False) -> int:
        """Apply a decision at the measured state; returns `Condition` bits of a violated stop or standstill.

        Time is that of the robot's stamps, so that a faulty clock cannot make a stop appear overdue. Sets
        `drive_wanted` and `standstill_q`. While the arm is `retreating` from a contact, its stop has not begun.
        """
        flags = self._update_drive(decision, state)
        if decision.action < SafetyAction.HOLD or not self.drive_wanted or retreating:
            self._stop_since, self.standstill_q = None, None
            return flags
        if self._stop_since is None:
            self._stop_since = state.stamp
        if self.standstill_q is None:
            if self._is_at_rest(state):
                self.standstill_q = state.q.copy()
            elif not state.stamp - self._stop_since <= self.limits.stop_timeout:
                flags |= C.STOP_OVERDUE
        elif not displacement(self.standstill_q, state).max() <= self.limits.max_drift:
            flags |= C.DRIFT
        if decision.action >= SafetyAction.CONTROLLED_STOP and self.standstill_q is not None:
            self._switch_drive(state, on=False)
        return flags

    def _update_drive(self, decision: SupervisorDecision, state: RobotState) -> int:
        """Switch the drive off or on as the decision requires; while it is off, check that the brakes hold.

        A drive is switched on only at rest, because the control begins at zero.
        """
        if (decision.action >= SafetyAction.ESTOP or decision.immediate_drive_off) and self.drive_wanted:
            self._switch_drive(state, on=False)
        elif decision.action < SafetyAction.CONTROLLED_STOP and not self.drive_wanted and self._is_at_rest(state):
            self._switch_drive(state, on=True)
        if self.drive_wanted or self._drive_off_stamp is None or not state.stamp > self._drive_off_stamp:
            return 0  # no state since the drive was switched off
        moved = displacement(self._drive_off_q, state)
        braked = state.stamp - self._drive_off_stamp > self.limits.brake_time
        fast = braked and not np.abs(state.v).max() <= 10.0 * self.limits.rest_velocity
        return C.FALLING if fast or not (moved <= self._coast_limit).all() else 0

    def _is_at_rest(self, state: RobotState) -> bool:
        return bool(np.abs(state.v).max() < self.limits.rest_velocity)

    def _switch_drive(self, state: RobotState, *, on: bool) -> None:
        self.drive_wanted, self._drive_off_stamp, self._drive_off_q = on, None if on else state.stamp, state.q.copy()
        self._coast_limit = self.limits.max_brake_slip + self.limits.brake_time * np.abs(state.v)


def displacement(q: Array, state: RobotState) -> Array:
    """Displacement (n,) of each control from `q` [m, rad]; for a base the distance in any direction."""
    moved = np.abs(state.q - q)
    return moved if len(q) == len(state.v) else np.array([np.hypot(moved[0], moved[1]), *moved[2:]])
