"""What the senses say of themselves: joint states that are late, twice, impossible, or do not follow the commands.

Two leaky integrals per joint (gaps between sources of the same motion; leak time T):

    e_s ← e_s (1 − dt/T) + (Δq − v̄ dt)         measured positions against measured velocities
    e_c ← e_c (1 − dt/T) + (Δq − û dt)          measured positions against the commands, û ← û + (u − û) dt/lag

A stuck, wrong or slow source makes one of them grow; noise and a lag that is known do not.
"""

from __future__ import annotations

from math import inf, isfinite

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.differential_drive import driven_by
from dualbrain.robots.interface import RobotState
from dualbrain.robots.model import Body
from dualbrain.safety.cbf.result import Filtered, Reason, Status
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.timing import SIMULATED, Timing

Array = NDArray[np.float64]

C = Condition
BEYOND = 0.05
"""A joint this far outside its range [rad] is a fault of the sensor or of the arm."""


class Bounds(msgspec.Struct, frozen=True):
    """How far sources may part: `agree`, `follow` (stop) and `lost` (drive off) [rad]; `leak` T [s]; `speed` a share.

    `jump` [rad] is what a position may change beyond the speed limit between two states. `scene_old` and `scene_stale`
    [s] are ages of a scene with moving things; `scene_ahead` [s]: how far its stamp may lie in the future. So many
    pictures in a row as `scene_frozen` that show a thing equal to the bit, though with noise, come from no camera.
    """

    agree: float = 0.01
    follow: float = 0.02
    lost: float = 0.05
    leak: float = 0.3
    speed: float = 1.15
    jump: float = 0.005
    scene_old: float = 0.15
    scene_stale: float = 0.5
    scene_ahead: float = 0.05
    scene_frozen: int = 3


class Watch:
    """Turns one tick's readings into `Condition` bits. Call `sensed` for each state, `commanded` for each control."""

    def __init__(self, body: Body, timing: Timing = SIMULATED, bounds: Bounds | None = None) -> None:
        """Nothing has been seen yet."""
        self.timing, self.bounds = timing, bounds or Bounds()
        joints = body.joints
        self._bolted = slice(3 if body.mobile else 0, None)
        """Where the joints with a range lie in q; a base may be anywhere."""
        ranged = joints[2:] if body.mobile else joints
        self._ranges = [(joint.lower.value - BEYOND, joint.upper.value + BEYOND) for joint in ranged]
        self._swift = [self.bounds.speed * joint.velocity.value for joint in joints]
        self._most = [1.001 * joint.velocity.value for joint in joints]
        self._lag = max(body.tracking.lag, timing.period)
        self._n = body.n
        self._last: RobotState | None = None
        self._good: RobotState | None = None
        self._u = [0.0] * body.n
        self.start()

    def start(self) -> None:
        """Forget the gaps: the drive was off, or a person moved the arm."""
        self._followed, self._source, self._command = ([0.0] * self._n for _ in range(3))

    # --- joint states -------------------------------------------------------------------------------------------

    def sensed(self, state: RobotState, now: float) -> int:
        """Bits for the joint state that was read at `now` [s]."""
        last, self._last = self._last, state
        flags = 0 if -self.timing.clock <= now - state.stamp < inf else C.CLOCK_STEP
        if last is not None and state.sequence <= last.sequence:
            flags |= C.STATE_REPEATED
        else:
            if last is not None and state.sequence > last.sequence + 1:
                flags |= C.STATE_MISSED
            flags |= self._plausible(state)
        return flags | self._aged(now)

    def _aged(self, now: float) -> int:
        """By the last state that could be: a stream of rubbish is no better than silence."""
        age = now - self._good.stamp if self._good else 0.0
        if age > self.timing.blind:
            return C.STATE_STALE | C.STATE_LOST
        return C.STATE_STALE if age > self.timing.stale else 0

    def _plausible(self, state: RobotState) -> int:
        """Finite, in range, no jump; then it is compared with velocities and commands."""
        q, v = state.q.tolist(), state.v.tolist()
        finite = all(map(isfinite, (*q, *v, state.opening, state.stamp)))
        if not finite or not inside(q[self._bolted], self._ranges):
            return C.STATE_IMPLAUSIBLE
        last, self._good = self._good, state
        if last is None:
            return 0
        dt = state.stamp - last.stamp
        if not 0.0 < dt < inf:
            return C.STATE_IMPLAUSIBLE if q != last.q.tolist() else 0
        if dt > self.timing.blind:  # nothing can be compared across such a gap
            self.start()
            return 0
        moved = (driven_by(last.q, state.q) if len(q) > self._n else state.q - last.q).tolist()
        if not slower(moved, [fast * dt + self.bounds.jump for fast in self._swift]):
            return C.STATE_IMPLAUSIBLE
        flags = 0 if slower(v, self._swift) else C.OVERSPEED
        return flags | self._compare(moved, (0.5 * (state.v + last.v)).tolist(), dt, driven=state.drive_enabled)

    def _compare(self, moved: list[float], v: list[float], dt: float, *, driven: bool) -> int:
        keep = max(0.0, 1.0 - dt / self.bounds.leak)
        self._source = [e * keep + (x - rate * dt) for e, x, rate in zip(self._source, moved, v, strict=True)]
        flags = C.SOURCES_DISAGREE if largest(self._source) > self.bounds.agree else 0
        if not driven:
            self._followed, self._command = [0.0] * self._n, [0.0] * self._n
            return flags
        share = min(1.0, dt / self._lag)
        self._followed = [w + (u - w) * share for w, u in zip(self._followed, self._u, strict=True)]
        self._command = [e * keep + (x - w * dt) for e, x, w in zip(self._command, moved, self._followed, strict=True)]
        gap = largest(self._command)
        if gap > self.bounds.lost:
            return flags | C.TRACKING_OFF | C.TRACKING_LOST
        return flags | C.TRACKING_OFF if gap > self.bounds.follow else flags

    def commanded(self, u: Array) -> int:
        """Bits for the control (n,) [rad/s] that is about to be written; independent of the filter's own checker."""
        wanted = u.tolist()
        if not slower(wanted, self._most):  # nor is a NaN
            return C.CONTROL_BAD
        self._u = wanted
        return 0

    @property
    def gaps(self) -> tuple[float, float]:
        """The largest gap [rad] of each kind now: between sources, and to the commands."""
        return largest(self._source), largest(self._command)


def inside(values: list[float], ranges: list[tuple[float, float]]) -> bool:
    """Whether every value lies in its range."""
    for value, (least, most) in zip(values, ranges, strict=True):  # noqa: SIM110  (every tick; half the time)
        if not least <= value <= most:
            return False
    return True


def slower(values: list[float], limits: list[float]) -> bool:
    """Whether no value is larger in size than its limit; a NaN is."""
    for value, limit in zip(values, limits, strict=True):  # noqa: SIM110
        if not abs(value) <= limit:
            return False
    return True


def largest(values: list[float]) -> float:
    """The largest size."""
    return max(map(abs, values))


STALE = int(Reason.STALE_SCENE)


def answered(result: Filtered) -> int:
    """Bits for the filter's answer; an old scene is the scene's condition, not the filter's."""
    if result.status < Status.RELAXED:
        return 0
    if result.status is Status.RELAXED:
        return C.INFEASIBLE
    if result.status is Status.FAULT:
        return C.FILTER_FAULT
    return C.SCENE_STALE if result.flags & ~int(Reason.JERK) == STALE else C.FILTER_STOPPED
