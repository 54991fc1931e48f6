"""Plausibility checks of joint states: late, repeated, implausible, or inconsistent with the commands.

Two leaky integrals per joint compare sources of the same motion (leak time T):

    e_s ← e_s (1 − dt/T) + (Δq − v̄ dt)         measured positions against measured velocities
    e_c ← e_c (1 − dt/T) + (Δq − û dt)          measured positions against commands, û ← û + (u − û) dt/lag

A stuck, wrong or slow source makes one of them grow; noise and a modelled lag do not.
"""

from __future__ import annotations

from math import inf, isfinite

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.differential_drive import control_displacement
from dualbrain.robots.interface import RobotState
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.result import FilterResult, FilterStatus, Reason
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.timing import SIMULATED, Timing

Array = NDArray[np.float64]

C = Condition
RANGE_TOLERANCE = 0.05
"""A joint that is farther outside its range [rad] indicates a fault of the sensor or of the arm."""


class MonitorLimits(msgspec.Struct, frozen=True, kw_only=True):
    """Limits of the plausibility checks.

    - `max_source_gap`, `max_tracking_gap` (stop) and `tracking_lost_gap` (drive off) [rad]: limits of the integrals.
      `leak_time` T [s].
    - `overspeed_factor`: multiple of the velocity limit. `max_position_jump` [rad]: change of a position between two
      states beyond the one that the velocity limit allows.
    - `scene_old_after`, `scene_stale_after` [s]: ages of a scene with moving objects. `max_scene_lead` [s]: how far the
      stamp of a scene may be in the future.
    - `max_identical_scenes`: consecutive observations that may repeat a noisy object bit for bit.
    """

    max_source_gap: float = 0.01
    max_tracking_gap: float = 0.02
    tracking_lost_gap: float = 0.05
    leak_time: float = 0.3
    overspeed_factor: float = 1.15
    max_position_jump: float = 0.005
    scene_old_after: float = 0.15
    scene_stale_after: float = 0.5
    max_scene_lead: float = 0.05
    max_identical_scenes: int = 3


class StateMonitor:
    """Detects `Condition` bits with `check_state` for each joint state and `check_control` for each control."""

    def __init__(
        self, robot_model: RobotModel, timing: Timing = SIMULATED, limits: MonitorLimits | None = None
    ) -> None:
        """Start without readings."""
        self.timing, self.limits = timing, limits or MonitorLimits()
        joints = robot_model.joints
        self._ranged_joints = slice(3 if robot_model.is_mobile else 0, None)
        """Slice of q with the joints that have a range; the pose of a base has none."""
        ranged = joints[2:] if robot_model.is_mobile else joints
        self._ranges = [(joint.lower.value - RANGE_TOLERANCE, joint.upper.value + RANGE_TOLERANCE) for joint in ranged]
        self._overspeed_limits = [self.limits.overspeed_factor * joint.velocity.value for joint in joints]
        self._control_limits = [1.001 * joint.velocity.value for joint in joints]
        self._lag = max(robot_model.tracking.lag, timing.period)
        self._n, self._nq = robot_model.n, robot_model.nq
        self._last: RobotState | None = None
        self._last_plausible: RobotState | None = None
        self._last_q: list[float] = []
        self._last_v: list[float] = []
        self._u = [0.0] * robot_model.n
        self.reset()

    def reset(self) -> None:
        """Clear the integrals, because the drive was off or a person moved the arm."""
        self._expected_velocity, self._source_gap, self._tracking_gap = ([0.0] * self._n for _ in range(3))

    # --- joint states -------------------------------------------------------------------------------------------

    def check_state(self, state: RobotState, now: float) -> int:
        """Bits for the joint state that was read at `now` [s]."""
        last, self._last = self._last, state
        flags = 0 if -self.timing.max_clock_skew <= now - state.stamp < inf else C.CLOCK_STEP
        if last is not None and state.sequence <= last.sequence:
            flags |= C.STATE_REPEATED
        else:
            if last is not None and state.sequence > last.sequence + 1:
                flags |= C.STATE_MISSED
            flags |= self._plausibility_conditions(state)
        return flags | self.check_age(now)

    def check_age(self, now: float) -> int:
        """Bits for the age of the last plausible state at `now` [s]; implausible states do not count as received."""
        age = now - self._last_plausible.stamp if self._last_plausible else 0.0
        if age > self.timing.state_lost_after:
            return C.STATE_STALE | C.STATE_LOST
        return C.STATE_STALE if age > self.timing.state_stale_after else 0

    def _plausibility_conditions(self, state: RobotState) -> int:
        """Bits for values that are missing, not finite, out of range or jump.

        Plausible states are compared across sources.
        """
        q, v = state.q.tolist(), state.v.tolist()
        if not self._is_plausible(state, q, v):
            return C.STATE_IMPLAUSIBLE
        last, self._last_plausible = self._last_plausible, state
        last_q, last_v, self._last_q, self._last_v = self._last_q, self._last_v, q, v
        if last is None:
            return 0
        dt = state.stamp - last.stamp
        if not 0.0 < dt < inf:
            return C.STATE_IMPLAUSIBLE if q != last_q else 0
        if dt > self.timing.state_lost_after:  # states before and after such a gap cannot be compared
            self.reset()
            return 0
        moved = self._displacement(last, state, last_q, q)
        if not all_within(moved, [fast * dt + self.limits.max_position_jump for fast in self._overspeed_limits]):
            return C.STATE_IMPLAUSIBLE
        flags = 0 if all_within(v, self._overspeed_limits) else C.OVERSPEED
        return flags | self._compare_sources(moved, last_v, v, dt, drive_enabled=state.drive_enabled)

    def _is_plausible(self, state: RobotState, q: list[float], v: list[float]) -> bool:
        """Whether every value is finite, every joint within its range, and no value missing.

        A sum is finite only if all its terms are.
        """
        total = sum(q) + sum(v) + sum(state.finger_forces) + (state.opening or 0.0) + state.stamp
        return (
            isfinite(total)
            and len(q) == self._nq
            and len(v) == self._n
            and all_in_range(q[self._ranged_joints], self._ranges)
            and (state.desired_v is None or self._is_motion(state.desired_v))
            and (state.desired_a is None or self._is_motion(state.desired_a))
        )

    def _is_motion(self, values: Array) -> bool:
        """Whether a reported command has n finite velocities or accelerations."""
        return len(values) == self._n and isfinite(sum(values.tolist()))

    def _displacement(self, last: RobotState, state: RobotState, last_q: list[float], q: list[float]) -> list[float]:
        """The displacement (n,) [rad, m] between two states, in the coordinates of the control."""
        if self._nq > self._n:
            return control_displacement(last.q, state.q).tolist()
        return [new - old for new, old in zip(q, last_q, strict=True)]

    def _compare_sources(
        self, moved: list[float], last_v: list[float], v: list[float], dt: float, *, drive_enabled: bool
    ) -> int:
        keep, half = max(0.0, 1.0 - dt / self.limits.leak_time), 0.5 * dt
        self._source_gap = [
            e * keep + (x - half * (old + new))
            for e, x, old, new in zip(self._source_gap, moved, last_v, v, strict=True)
        ]
        flags = C.SOURCES_DISAGREE if max_abs(self._source_gap) > self.limits.max_source_gap else 0
        if not drive_enabled:
            self._expected_velocity, self._tracking_gap = [0.0] * self._n, [0.0] * self._n
            return flags
        share = min(1.0, dt / self._lag)
        self._expected_velocity = [w + (u - w) * share for w, u in zip(self._expected_velocity, self._u, strict=True)]
        self._tracking_gap = [
            e * keep + (x - w * dt) for e, x, w in zip(self._tracking_gap, moved, self._expected_velocity, strict=True)
        ]
        gap = max_abs(self._tracking_gap)
        if gap > self.limits.tracking_lost_gap:
            return flags | C.TRACKING_OFF | C.TRACKING_LOST
        return flags | C.TRACKING_OFF if gap > self.limits.max_tracking_gap else flags

    def check_control(self, u: Array) -> int:
        """Bits for the control (n,) [rad/s] that is about to be written; independent of the filter's own checker."""
        values = u.tolist()
        if not all_within(values, self._control_limits):  # also rejects NaN
            return C.CONTROL_BAD
        self._u = values
        return 0


def all_in_range(values: list[float], ranges: list[tuple[float, float]]) -> bool:
    """Whether every value is in its range; NaN is not."""
    for value, (least, most) in zip(values, ranges, strict=True):  # noqa: SIM110  (runs in every tick; twice as fast as all())
        if not least <= value <= most:
            return False
    return True


def all_within(values: list[float], limits: list[float]) -> bool:
    """Whether no absolute value exceeds its limit; NaN does."""
    for value, limit in zip(values, limits, strict=True):  # noqa: SIM110
        if not abs(value) <= limit:
            return False
    return True


def max_abs(values: list[float]) -> float:
    """The largest absolute value."""
    return max(map(abs, values))


STALE_SCENE, RETREAT = int(Reason.STALE_SCENE), int(Reason.RETREAT)


def result_conditions(result: FilterResult) -> int:
    """Bits for a filter result; a stale scene is a condition of the scene, not of the filter.

    A retreat that ends the approach of an obstacle in time is no condition: the robot evades within its acceleration.
    """
    if result.status < FilterStatus.RELAXED:
        return 0
    if result.status is FilterStatus.RELAXED:
        return 0 if result.flags & RETREAT else C.INFEASIBLE
    if result.status is FilterStatus.FAULT:
        return C.FILTER_FAULT
    return C.SCENE_STALE if result.flags & ~int(Reason.JERK) == STALE_SCENE else C.FILTER_STOPPED
