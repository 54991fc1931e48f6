"""Safety controller: one control tick from sensor readings to the control that is written to the robot.

Readings → conditions → decision → scaled nominal control → filter → consistency check → control. Lockstep evaluation
and the real-time gatekeeper run the same code with different clocks.
"""

from __future__ import annotations

from math import nan

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.interface import RobotState
from dualbrain.safety.cbf.filter import SafetyFilter, SupervisedTick
from dualbrain.safety.cbf.result import FilterResult
from dualbrain.safety.contact_force.limits import ContactForceLimits
from dualbrain.safety.contact_force.monitor import ContactForceMonitor
from dualbrain.safety.contact_force.retreat import Retreat
from dualbrain.safety.supervisor.actions import SafetyAction, SupervisorDecision
from dualbrain.safety.supervisor.checks import ContractOutcome
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.enforcement import Enforcement, StandstillLimits
from dualbrain.safety.supervisor.intervention import is_consistent, with_supervisor_control
from dualbrain.safety.supervisor.loop_delay import LATE_TICK_PERIODS, LoopDelay
from dualbrain.safety.supervisor.state_monitor import MonitorLimits, StateMonitor, result_conditions
from dualbrain.safety.supervisor.supervisor import Supervisor
from dualbrain.safety.supervisor.timing import SIMULATED, Timing

Array = NDArray[np.float64]

UNSCALED, STANDSTILL, BRAKING = 1.0, -1.0, -2.0
"""Actions of the supervisor on a control, as the trace stores them: a scale in [0, 1], or u = 0, or braking."""
SILENT_BUS_CONDITIONS = int(
    Condition.STATE_STALE | Condition.STATE_LOST | Condition.TICK_LOST | Condition.FILTER_STOPPED
)
"""Conditions that a silent robot link causes. Some links are silent while the drive is being switched on."""
CONTACT_CHECK = "unexpected_contact"
"""The check that lets the arm retreat before it stops."""
UNUSABLE_STATE_CONDITIONS = int(Condition.STATE_IMPLAUSIBLE | Condition.STATE_REPEATED)


class SafetyController:
    """Supervisor, state monitor, enforcement and filter of one robot; the operator sets `speed_scale` in (0, 1]."""

    def __init__(
        self,
        safety: SafetyFilter,
        *,
        timing: Timing = SIMULATED,
        monitor_limits: MonitorLimits | None = None,
        standstill_limits: StandstillLimits | None = None,
        contact_limits: ContactForceLimits | None = None,
    ) -> None:
        """Start without conditions, with the drive on and at full speed (`speed_scale` 1).

        `safety` filters every control of its robot with n joints. `timing` holds the control period and the limits on
        delays [s], by default those of the simulator in lockstep. `monitor_limits` and `standstill_limits` decide when
        a reading is implausible, and when the robot counts as at rest and stays there; None: the defaults of
        `MonitorLimits` and `StandstillLimits`. No value of these limits raises an error. `contact_limits` are those of
        the contact force, which is supervised if the robot model declares `force_sensing`.

        Raises `ConfigurationError` if the model declares it without a dynamic model.
        """
        self.safety, self.speed_scale = safety, 1.0
        self.supervisor = Supervisor()
        self.monitor = StateMonitor(safety.robot_model, timing, monitor_limits)
        self.enforcement = Enforcement(standstill_limits)
        self.contact = ContactForceMonitor(safety, contact_limits) if safety.robot_model.force_sensing else None
        """The contact force, None without force sensing."""
        self._retreat = Retreat(self.contact) if self.contact is not None else None
        self._period = max(timing.period, safety.robot_model.period)
        self.loop_delay = LoopDelay(self._period)
        self.scale_applied = UNSCALED
        joints = safety.robot_model.joints
        self._braking_step = np.array([joint.acceleration.value for joint in joints]) * safety.robot_model.period
        self._velocity_limits = np.array([joint.velocity.value for joint in joints])
        self._pending, self._conditions = 0, 0
        self._last_tick = nan
        self._drive_came_on, self._drive_request_stamp, self._drive_request_time = True, nan, nan
        self._u = np.zeros(safety.robot_model.n)
        self._continued_sequence: int = -1

    @property
    def decision(self) -> SupervisorDecision:
        """The decision in force."""
        return self.supervisor.decision

    @property
    def contract_outcome(self) -> ContractOutcome:
        """Outcome with which a running contract must end; "" while it may continue."""
        return self.supervisor.contract_outcome

    @property
    def drive_wanted(self) -> bool:
        """Whether the drive should be on."""
        return self.enforcement.drive_wanted

    def accept_state(self, state: RobotState, now: float) -> bool:
        """Check a joint state read at `now` [s]; False if it must not be used (implausible or repeated)."""
        flags = self.monitor.check_state(state, now)
        usable = not flags & UNUSABLE_STATE_CONDITIONS
        if usable and self.contact is not None and self.contact.update(state):
            flags |= Condition.UNEXPECTED_CONTACT
        self._pending |= flags
        return usable

    def report(self, conditions: int) -> None:
        """Add `Condition` bits that other components detected since the last decision."""
        self._pending |= conditions

    def decide(self, state: RobotState, now: float, external_conditions: int = 0) -> SupervisorDecision:
        """Decision for this tick from all conditions since the last one and from `external_conditions` of this tick."""
        external_conditions |= self._tick_gap_conditions(now) | self._loop_delay_conditions(now, state.stamp)
        if self.speed_scale < 1.0:
            external_conditions |= Condition.SPEED_STAGE
        flags, self._pending = self._pending | external_conditions, 0
        if not self._drive_came_on and now - self._drive_request_time < self.monitor.timing.drive_on_silence:
            flags &= ~SILENT_BUS_CONDITIONS
        flags |= self.safety.target_conditions()  # a target masks its own conditions
        drive_was_wanted = self.enforcement.drive_wanted
        decision, self._conditions = self.supervisor.update(now, flags), flags
        if self._retreat is not None:
            self._retreat.update(state, wanted=decision.check == CONTACT_CHECK)
        retreating = self._retreat is not None and self._retreat.active
        self._pending = self.enforcement.apply(decision, state, retreating=retreating)
        if self.enforcement.drive_wanted and not drive_was_wanted:
            self.expect_drive_on(state, now)
        if self.enforcement.drive_wanted and self._drive_dropped(state):
            self._pending |= Condition.DRIVE_DROPPED
        return decision

    @property
    def commanded_speed(self) -> float:
        """Largest speed of a joint in the last control [rad/s]."""
        return max(map(abs, self._u.tolist()))

    @property
    def retreating(self) -> bool:
        """Whether the arm yields to a contact force; its nominal control is then `retreat_control`."""
        if self._retreat is None or self.contact is None:
            return False
        return self._retreat.active or (self.contact.yielding and self.decision.action < SafetyAction.HOVER)

    def retreat_control(self) -> Array:
        """The nominal control (n,) [rad/s] of a retreat, zero without one."""
        return self._retreat.control(len(self._u)) if self._retreat is not None else np.zeros_like(self._u)

    def yield_to_contact(self, state: RobotState) -> Array | None:
        """Set the filter's last control to the yielding one (n,) [rad/s]; None if it is that already."""
        if self._retreat is None:
            return None
        u = np.clip(self._retreat.yielding_control(state, self._u), -self._velocity_limits, self._velocity_limits)
        if np.array_equal(u, self._u):
            return None
        self.safety.reset(u)
        return u

    def continue_desired_motion(self, state: RobotState) -> tuple[Array, Array] | None:
        """Continue the command that the robot executes if it is not the last one, which was lost on the way.

        A robot continues a lost command by itself. The limits of acceleration and jerk of the next control are then
        those around the executed velocity. Returns it and its change in the last period, both (n,) [rad/s]; None if the
        robot executes the last control, or does not report the command.
        """
        if state.desired_v is None or state.desired_a is None or not (self.drive_wanted and state.drive_enabled):
            return None
        if state.sequence == self._continued_sequence:
            return None  # the command since then cannot be in this state
        self._continued_sequence = state.sequence
        if state.executes(self._u):
            return None
        u = np.clip(state.desired_v, -self._velocity_limits, self._velocity_limits)
        change = np.clip(state.desired_a * self.safety.robot_model.period, -self._braking_step, self._braking_step)
        self.safety.reset(u, change)
        self.monitor.check_control(u)
        self._u = u
        return u, change

    def clear_filter_memory(self) -> Array:
        """Clear the memory of the filter except for the last control (n,) [rad/s], which is returned."""
        self.safety.reset(self._u)
        return self._u

    def expect_drive_on(self, state: RobotState, now: float) -> None:
        """Record that the drive was requested on at `now` [s]; it must be on within `Timing.drive_on_timeout`."""
        self._drive_came_on, self._drive_request_stamp, self._drive_request_time = False, state.stamp, now

    def _drive_dropped(self, state: RobotState) -> bool:
        """Whether a wanted drive went off, or is not on in time; a drive reacts a few periods after the request."""
        if state.drive_enabled:
            self._drive_came_on = True
            return False
        return (
            self._drive_came_on or not state.stamp - self._drive_request_stamp <= self.monitor.timing.drive_on_timeout
        )

    def _tick_gap_conditions(self, now: float) -> int:
        """Bits for the time since the last tick, by the clock of the control loop."""
        gap, self._last_tick = now - self._last_tick, now
        if not gap > LATE_TICK_PERIODS * self._period:  # true for the first tick and for NaN, too
            return 0
        return (
            Condition.TICK_LOST | Condition.TICK_OVERRUN
            if gap > self.monitor.timing.tick_lost_after
            else Condition.TICK_OVERRUN
        )

    def _loop_delay_conditions(self, now: float, stamp: float) -> int:
        """Bits for commands that stay in force too long by the robot's stamps and by the clock of the control loop."""
        moving = self.commanded_speed > self.enforcement.limits.rest_velocity
        delay = self.loop_delay.update(now, stamp, moving=moving)
        return Condition.LOOP_BEHIND if delay > self.monitor.timing.max_loop_delay else 0

    def control(self, state: RobotState, u_nom: Array, now: float, *, guard: bool = True) -> FilterResult:
        """The control to write under the decision in force: scaled, filtered and checked; sets `scale_applied`.

        It is zero at a standstill, while the drive is off, and while it is being switched on.

        `u_nom` (n,) [rad/s] is the nominal control at `now` [s]. With `guard=False` the filter runs without effect, for
        experiments without a filter.
        """
        scale = UNSCALED if self.retreating else self.enforcement.scale(self.decision, self.speed_scale)
        scaled = u_nom if scale == 1.0 else scale * u_nom + 0.0  # 0 and not -0, as a target zeroes it
        self.safety.supervise(
            SupervisedTick(
                now=now,
                stamp=state.stamp,
                conditions=self._conditions,
                yielding=self.retreating,
                standstill=self.enforcement.at_standstill,
                stopped=self.decision.action >= SafetyAction.CONTROLLED_STOP,
                action=int(self.decision.action),
            )
        )
        result = self.safety.filter(state, scaled, now)
        self._pending |= result_conditions(result)
        if not guard:
            result = result.unfiltered()
        self.scale_applied = scale
        if self.enforcement.at_standstill or not self.drive_wanted or not self._drive_came_on:
            self.scale_applied, u = STANDSTILL, np.zeros_like(result.u)
        elif bad := self.monitor.check_control(result.u) or (
            0 if is_consistent(result, scaled) else Condition.CONTROL_BAD
        ):
            self._pending |= bad
            self.scale_applied, u = BRAKING, self._braking_control()
        else:
            u = result.u
        if self.scale_applied != UNSCALED:
            result = with_supervisor_control(result, u_nom, u)
        if self.scale_applied < 0.0:
            self.safety.reset(u)
            self.monitor.check_control(u)
        self._u = result.u
        return result

    def _braking_control(self) -> Array:
        """The last control reduced by one factor for all joints, as fast as every acceleration limit allows."""
        speed = np.abs(self._u)
        moving = speed > 1e-9
        factor = 1.0 - float(np.min(self._braking_step[moving] / speed[moving])) if moving.any() else 0.0
        return max(0.0, factor) * self._u
