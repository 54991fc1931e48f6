"""What an order makes of the control and of the drive: slow down, stand still and be watched, brake, switch off.

    u_nom' = s u_nom      with s = 1 (NONE, WARN), the speed stage (SLOW), 0 (HOVER and above): then the filter
    u      = 0            once a HOLD or CONTROLLED_STOP has come to rest; the joints are watched from there

The nominal control is scaled *before* the filter, so that nothing changes u after its certificate; the zero of a
standstill is written only when the arm already rests.
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
    """When an arm counts as standing: `rest` [rad/s], `drift` allowed from there [rad].

    `stop` [s] is the longest that braking may take; `brakes` [s] what the brakes need to bring the arm to rest, `fall`
    [rad] how far it may move beyond what it would coast in that time; `slow` is the scale of SLOW where no speed stage
    is chosen.
    """

    rest_velocity: float = 0.01
    max_drift: float = 0.01
    stop_timeout: float = 0.8
    brake_time: float = 0.4
    max_brake_slip: float = 0.03
    slow_scale: float = 0.5


class Enforcement:
    """Keeps what an order needs from tick to tick: since when, where the arm stood, whether the drive is wanted."""

    def __init__(self, limits: StandstillLimits | None = None) -> None:
        """The drive is wanted, no order is in force."""
        self.limits = limits or StandstillLimits()
        self.drive_wanted = True
        self.standstill_q: Array | None = None
        self._stop_since: float | None = None
        self._drive_off_stamp: float | None = None
        self._drive_off_q = self._coast_limit = np.zeros(0)

    def scale(self, decision: SupervisorDecision, speed_stage: float) -> float:
        """S in [0, 1]: what is left of the nominal control; `stage` is the speed that a person has chosen."""
        if decision.action >= SafetyAction.HOVER:
            return 0.0
        if decision.action < SafetyAction.SLOW:
            return 1.0
        return speed_stage if decision.check == "speed_stage" else min(speed_stage, self.limits.slow_scale)

    @property
    def at_standstill(self) -> bool:
        """Whether u = 0 is to be written: the arm has come to rest under an order to stand."""
        return self.standstill_q is not None

    def apply(self, decision: SupervisorDecision, state: RobotState) -> int:
        """Take in the order and the measured state; returns the `Condition` bits that a broken standstill sets.

        Time here is the robot's own (its stamps), so that a broken clock cannot make a stop look overdue.
        Sets `driving` and `standing`, which the local layer acts on.
        """
        flags = self._update_drive(decision, state)
        if decision.action < SafetyAction.HOLD or not self.drive_wanted:
            self._stop_since, self.standstill_q = None, None
            return flags
        if self._stop_since is None:
            self._stop_since = state.stamp
        if self.standstill_q is None:
            if np.abs(state.v).max() < self.limits.rest_velocity:
                self.standstill_q = state.q.copy()
            elif not state.stamp - self._stop_since <= self.limits.stop_timeout:
                flags |= C.STOP_OVERDUE
        elif not displacement(self.standstill_q, state).max() <= self.limits.max_drift:
            flags |= C.DRIFT
        if decision.action >= SafetyAction.CONTROLLED_STOP and self.standstill_q is not None:
            self._switch_drive(state, on=False)
        return flags

    def _update_drive(self, decision: SupervisorDecision, state: RobotState) -> int:
        """Off at once for ESTOP or `Order.at_once`; on again below CONTROLLED_STOP; while off, the brakes must hold."""
        if (decision.action >= SafetyAction.ESTOP or decision.immediate_drive_off) and self.drive_wanted:
            self._switch_drive(state, on=False)
        elif decision.action < SafetyAction.CONTROLLED_STOP and not self.drive_wanted:
            self._switch_drive(state, on=True)
        if (
            self.drive_wanted or self._drive_off_stamp is None or not state.stamp > self._drive_off_stamp
        ):  # nothing is known since
            return 0
        moved = displacement(self._drive_off_q, state)
        braked = state.stamp - self._drive_off_stamp > self.limits.brake_time
        fast = braked and not np.abs(state.v).max() <= 10.0 * self.limits.rest_velocity
        return C.FALLING if fast or not (moved <= self._coast_limit).all() else 0

    def _switch_drive(self, state: RobotState, *, on: bool) -> None:
        self.drive_wanted, self._drive_off_stamp, self._drive_off_q = on, None if on else state.stamp, state.q.copy()
        self._coast_limit = self.limits.max_brake_slip + self.limits.brake_time * np.abs(state.v)


def displacement(q: Array, state: RobotState) -> Array:
    """How far each control's part (n,) has come from `q` [m, rad]; of a base the way, in whatever direction."""
    moved = np.abs(state.q - q)
    return moved if len(q) == len(state.v) else np.array([np.hypot(moved[0], moved[1]), *moved[2:]])
