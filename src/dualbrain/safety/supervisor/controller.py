"""The spinal cord's tick: readings → conditions → order → scaled nominal → filter → check → the control to write.

Lockstep evaluation and the real-time gatekeeper run this same code; they differ in the clock that they hand in.
"""

from __future__ import annotations

from math import nan

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.interface import RobotState
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.result import Filtered
from dualbrain.safety.supervisor.actions import Order
from dualbrain.safety.supervisor.checks import Ending
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.enforcement import Enforcement, Standstill
from dualbrain.safety.supervisor.intervention import answers, supervised
from dualbrain.safety.supervisor.loop_delay import GAP, Lateness
from dualbrain.safety.supervisor.state_monitor import Bounds, Watch, answered
from dualbrain.safety.supervisor.supervisor import Supervisor
from dualbrain.safety.supervisor.timing import SIMULATED, Timing

Array = NDArray[np.float64]

UNTOUCHED, STANDING, BRAKED = 1.0, -1.0, -2.0
"""What the supervisor did to a tick's control, as the trace holds it: a scale in [0, 1], or u = 0, or braking."""
SILENT = int(Condition.STATE_STALE | Condition.STATE_LOST | Condition.TICK_LOST)
"""What a bus that is silent looks like; some are while their drive is switched on."""
UNUSABLE = int(Condition.STATE_IMPLAUSIBLE | Condition.STATE_REPEATED)


class Spine:
    """Supervisor, watch, enforcement and filter of one robot. `stage` is the speed that a person has chosen, (0, 1]."""

    def __init__(
        self, safety: SafetyFilter, *, timing: Timing = SIMULATED, bounds: Bounds | None = None,
        dials: Standstill | None = None,
    ) -> None:  # fmt: skip
        """Nothing is wrong yet; the drive is on."""
        self.safety, self.stage = safety, 1.0
        self.supervisor = Supervisor()
        self.watch = Watch(safety.body, timing, bounds)
        self.enforcement = Enforcement(dials)
        self._period = max(timing.period, safety.body.period)
        self.lateness = Lateness(self._period)
        self.touched = UNTOUCHED
        joints = safety.body.joints
        self._brake = np.array([joint.acceleration.value for joint in joints]) * safety.body.period
        self._pending = 0
        self._then = nan
        self._came_on, self._asked_on, self._asked_at = True, nan, nan
        self._u = np.zeros(safety.body.n)

    @property
    def order(self) -> Order:
        """What holds now."""
        return self.supervisor.order

    @property
    def ending(self) -> Ending:
        """How a contract that runs now has to end; "" while it may go on."""
        return self.supervisor.ending

    @property
    def driving(self) -> bool:
        """Whether the drive is wanted on."""
        return self.enforcement.driving

    def sensed(self, state: RobotState, now: float) -> bool:
        """Take in a joint state; False if it must not be used (impossible, or the same again)."""
        flags = self.watch.sensed(state, now)
        self._pending |= flags
        return not flags & UNUSABLE

    def flag(self, conditions: int) -> None:
        """Something else was found to be wrong since the last order."""
        self._pending |= conditions

    def judge(self, state: RobotState, now: float, asked: int = 0) -> Order:
        """The order for this tick, from everything flagged since the last one and what is `asked` for now."""
        asked |= self._gap(now) | self._behind(now, state.stamp)
        if self.stage < 1.0:
            asked |= Condition.SPEED_STAGE
        flags, self._pending = self._pending | asked, 0
        if not self._came_on and now - self._asked_at < self.watch.timing.quiet:
            flags &= ~SILENT
        was_driving = self.enforcement.driving
        order = self.supervisor.update(now, flags)
        self._pending = self.enforcement.obey(order, state)
        if self.enforcement.driving and not was_driving:
            self.switched_on(state, now)
        if self.enforcement.driving and self._dropped(state):
            self._pending |= Condition.DRIVE_DROPPED
        return order

    def switched_on(self, state: RobotState, now: float) -> None:
        """The drive was asked to come on from outside, at `now` [s]: it has `Timing.switching` to do so."""
        self._came_on, self._asked_on, self._asked_at = False, state.stamp, now

    def _dropped(self, state: RobotState) -> bool:
        """Whether a drive that is wanted went off, or does not come on in time: it answers a few periods later."""
        if state.drive_enabled:
            self._came_on = True
            return False
        return self._came_on or not state.stamp - self._asked_on <= self.watch.timing.switching

    def _gap(self, now: float) -> int:
        """Bits for the time since the last tick, by the layer's own clock."""
        gap, self._then = now - self._then, now
        if not gap > GAP * self._period:  # also the first tick, and what is no number
            return 0
        return Condition.TICK_LOST | Condition.TICK_OVERRUN if gap > self.watch.timing.lost else Condition.TICK_OVERRUN

    def _behind(self, now: float, stamp: float) -> int:
        """Bits for commands that stay in force too long, as the robot's stamps and the layer's clock both have it."""
        moving = max(map(abs, self._u.tolist())) > self.enforcement.dials.rest
        behind = self.lateness.update(now, stamp, moving=moving)
        return Condition.LOOP_BEHIND if behind > self.watch.timing.behind else 0

    def control(self, state: RobotState, u_nom: Array, now: float, *, guard: bool = True) -> Filtered:
        """The control to write under the order in force: scaled, filtered, checked once more (`touched` says how)."""
        scale = self.enforcement.scale(self.order, self.stage)
        asked = u_nom if scale == 1.0 else scale * u_nom
        result = self.safety.filter(state, asked, now)
        self._pending |= answered(result)
        if not guard:
            result = result.unfiltered()
        self.touched = scale
        if self.enforcement.standing or not self.driving:
            self.touched, u = STANDING, np.zeros_like(result.u)
        elif bad := self.watch.commanded(result.u) or (0 if answers(result, asked) else Condition.CONTROL_BAD):
            self._pending |= bad
            self.touched, u = BRAKED, self._braking()
        else:
            u = result.u
        if self.touched != UNTOUCHED:
            result = supervised(result, u_nom, u)
        if self.touched < 0.0:
            self.safety.reset(u)
            self.watch.commanded(u)
        self._u = result.u
        return result

    def _braking(self) -> Array:
        """The last control slowed by one factor for all joints, as hard as every joint's acceleration allows."""
        speed = np.abs(self._u)
        moving = speed > 1e-9
        factor = 1.0 - float(np.min(self._brake[moving] / speed[moving])) if moving.any() else 0.0
        return max(0.0, factor) * self._u
