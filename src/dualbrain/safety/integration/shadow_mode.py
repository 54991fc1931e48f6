"""Observe mode: the filter runs beside a controller, touches nothing, and tells what it would have changed."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from math import inf, isfinite
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.result import OBSTACLE, SELF, FilterResult, FilterStatus, Reason
from dualbrain.safety.integration.intervention_log import InterventionInterval, OpenInterval

Array = NDArray[np.float64]

DEAD_BAND = 1e-4
"""A delta up to this is the kernel's rounding and counts as unchanged."""
MAX_COMMAND_AGE = 0.1
"""After this long [s] without a call the last command is no longer what the robot does."""
REFUSED_REASONS = int(
    Reason.BAD_INPUT | Reason.STALE_STATE | Reason.STALE_SCENE | Reason.OUTSIDE_LIMITS | Reason.BAD_SCENE
)
"""Reasons for which the kernel looks at no distance: `h_min` then says nothing."""


class ShadowTick(NamedTuple):
    """What the shadow saw at `now` [s]; `h_min` [m] is None where the input was refused.

    `nearest` names the pair of least h; looked up in ticks that are changed or deeper than all before, else "".
    """

    now: float
    delta: float
    status: FilterStatus
    h_min: float | None
    nearest: str


class ShadowSummary(msgspec.Struct, frozen=True, kw_only=True):
    """A whole session of observing.

    `changed` of `ticks` would have got another control; `refused` had an input that the filter stops at; `late` came
    more than half a period too late. `Delta` is the mean of delta. `least` and `largest` are the ticks of least h and
    of largest delta (None: there was none). `unwritten` episodes were refused by the disk.
    """

    ticks: int
    changed_ticks: int
    refused_ticks: int
    late_calls: int
    Delta: float
    by_status: dict[str, int]
    min_h_tick: ShadowTick | None
    max_delta_tick: ShadowTick | None
    intervals: int
    intervention_time: float
    write_errors: int

    @property
    def changed_fraction(self) -> float:
        """Share of the ticks that would have been changed."""
        return self.changed_ticks / self.ticks if self.ticks else 0.0

    def explain(self) -> str:
        """A few sentences for people."""
        if not self.ticks:
            return "nothing observed"
        words = [
            f"{self.ticks} ticks observed, {self.changed_fraction:.2%} of them would have been changed,"
            f" in {self.intervals} episodes of {self.intervention_time:.2f} s together; Δ {self.Delta:.4f}."
        ]
        if self.min_h_tick and self.min_h_tick.h_min is not None:
            near = f" ({self.min_h_tick.nearest})" if self.min_h_tick.nearest else ""
            words.append(f"Least h {self.min_h_tick.h_min * 1e3:.1f} mm at {self.min_h_tick.now:.3f} s{near}.")
        if self.max_delta_tick:
            words.append(
                f"Largest change in one period {self.max_delta_tick.delta:.1%} of full speed at {self.max_delta_tick.now:.3f} s."
            )
        if self.refused_ticks:
            words.append(f"{self.refused_ticks} ticks had an input that the filter stops at: mend this first.")
        if self.late_calls:
            words.append(f"{self.late_calls} calls came late: does the body's period fit the controller's?")
        if self.write_errors:
            words.append(f"{self.write_errors} episodes could not be written.")
        return " ".join(words)


class ShadowFilter:
    """Watches a controller with a `SafetyFilter` of its own and commands nothing.

    Each tick is judged by itself: the filter's last control is what the robot was truly commanded, never the filter's
    own answer, which nobody applied. What it tells is therefore "this command, now, would have become that one"; it is
    not the motion that would have followed, because the first change would have led to other states. Two things follow.
    A delta is at most what acceleration limits allow in one period: how long an episode lasts and how small h gets say
    more than its peak. And a controller that is already faster than a row allows cannot be brought back within one
    period: such ticks are RELAXED, where a filter in charge would have slowed it down in time.

    Memory is bounded: sums, the last `keep` ticks (`recent`), and the open episode.
    """

    def __init__(
        self,
        safety: SafetyFilter,
        *,
        on_interval: Callable[[InterventionInterval], None] | None = None,
        dead_band: float = DEAD_BAND,
        merge_gap: float = 0.05,
        max_duration: float = 10.0,
        history: int = 1000,
    ) -> None:
        """Watch with `safety`, which nobody else may call; tell it of obstacles by `safety.observe` as usual.

        `told` gets every closed episode (an `EpisodeFile`, for instance). Changes less than `join` [s] apart are one
        episode; one that lasts is told in pieces of `longest` [s]. A delta up to `dead_band` is no change.

        Raises:
            InvalidSetup: the filter has jerk limits, which need two commands of the past.
        """
        if safety.config.jerk_limits:
            raise ConfigurationError(
                "jerk limits of a filter that observes",
                got=True,
                allowed="False",
                fix="It starts anew from the command of each tick and knows no change of it.",
            )
        self.safety, self.recent = safety, deque[ShadowTick](maxlen=history)
        self._on_interval, self._dead_band, self._merge_gap, self._max_duration = (
            on_interval,
            dead_band,
            merge_gap,
            max_duration,
        )
        self._v_max = np.array([joint.velocity.value for joint in safety.robot_model.joints])
        self._u_prev: Array | None = None
        self._now = -inf
        self._interval: OpenInterval | None = None
        self._by_status: Counter[FilterStatus] = Counter()
        self._min_h_tick: ShadowTick | None = None
        self._max_delta_tick: ShadowTick | None = None
        self._ticks = self._changed = self._refused = self._late = self._intervals = self._write_errors = 0
        self._sum, self._intervention_time, self._h_min = 0.0, 0.0, inf

    def evaluate(
        self, q: Array, v: Array, u_nom: Array, now: float, *, u_prev: Array | None = None, opening: float = 0.0
    ) -> FilterResult:
        """What the filter would make of the command `u_nom` (n,) [rad/s] at joint angles q and velocities v, now.

        `u_prev` is the velocity command in force until now; by default the `u_nom` of the call before or, at the start
        and after a pause of 0.1 s, v. Give it where the drive was commanded something else (a rate limiter in between).
        """
        moment = now if isfinite(now) else max(0.0, self._now)
        if moment < self._now:  # another session: the clock began anew
            self.reset()
        q, v, u_nom = (np.array(values, float) for values in (q, v, u_nom))
        last = self._previous_command(v, moment, u_prev)
        self.safety.reset(last)
        answer = self.safety(q, v, u_nom, now, opening=opening)
        self._late += 1.5 * self.safety.robot_model.period < moment - self._now < inf
        self._now, self._u_prev = moment, u_nom
        self._record(answer, moment, last)
        return answer

    def reset(self) -> None:
        """The next call is the first of another session: end the open episode, forget the last command."""
        if self._interval:
            self._close_interval(self._interval)
        self._u_prev, self._now = None, -inf

    def close(self) -> ShadowSummary:
        """End the open episode and sum up; `told` itself is the caller's to close."""
        if self._interval:
            self._close_interval(self._interval)
        return self.summary()

    def summary(self) -> ShadowSummary:
        """What was observed so far; an open episode is not yet in the episodes."""
        return ShadowSummary(
            ticks=self._ticks,
            changed_ticks=self._changed,
            refused_ticks=self._refused,
            late_calls=self._late,
            Delta=self._sum / max(1, self._ticks),
            by_status={status.name: self._by_status[status] for status in FilterStatus},
            min_h_tick=self._min_h_tick,
            max_delta_tick=self._max_delta_tick,
            intervals=self._intervals,
            intervention_time=self._intervention_time,
            write_errors=self._write_errors,
        )

    # --- inside -------------------------------------------------------------------------------------------------

    def _previous_command(self, v: Array, now: float, u_prev: Array | None) -> Array:
        """The last command, as far as a velocity limit allows it; never NaN."""
        if u_prev is None:
            fresh = now - self._now <= max(MAX_COMMAND_AGE, 2.0 * self.safety.robot_model.period)
            u_prev = self._u_prev if fresh and self._u_prev is not None else v
        if not np.isfinite(u_prev).all():
            u_prev = np.where(np.isfinite(u_prev), u_prev, np.where(np.isfinite(v), v, 0.0))
        return np.minimum(np.maximum(u_prev, -self._v_max), self._v_max)

    def _record(self, answer: FilterResult, now: float, u_prev: Array) -> None:
        refused = answer.flags & REFUSED_REASONS != 0
        changed = answer.delta > self._dead_band or answer.status > FilterStatus.MODIFIED
        deepest = not refused and answer.h_min < self._h_min
        nearest = self._nearest_pair() if (changed or deepest) and not refused else ""
        tick = ShadowTick(now, answer.delta, answer.status, None if refused else answer.h_min, nearest)
        self.recent.append(tick)
        self._ticks, self._changed, self._refused = self._ticks + 1, self._changed + changed, self._refused + refused
        self._sum += answer.delta
        self._by_status[answer.status] += 1
        if deepest:
            self._min_h_tick, self._h_min = tick, answer.h_min
        if changed and (self._max_delta_tick is None or tick.delta > self._max_delta_tick.delta):
            self._max_delta_tick = tick
        self._update_interval(tick, changed, answer, u_prev)

    def _nearest_pair(self) -> str:
        """The pair of least h among the rows of the last step."""
        pairs = [row for row in self.safety.rows() if row.kind in (OBSTACLE, SELF)]
        return min(pairs, key=lambda row: row.h).name if pairs else ""

    def _update_interval(self, tick: ShadowTick, changed: bool, answer: FilterResult, u_prev: Array) -> None:
        """Open, extend or end an episode."""
        if self._interval and tick.now - self._interval.end > self._merge_gap:
            self._close_interval(self._interval)
        if not changed:
            return
        if self._interval and tick.now - self._interval.start >= self._max_duration:
            self._close_interval(self._interval, continued=True)
        if self._interval is None:
            self._interval = OpenInterval(tick.now)
        self._interval.add(tick.now, answer, tick.h_min, answer.cause)

    def _close_interval(self, interval: OpenInterval, *, continued: bool = False) -> None:
        self._interval = None
        self._intervals += 1
        self._intervention_time += interval.end - interval.start + self.safety.robot_model.period
        if self._on_interval:
            try:
                self._on_interval(interval.finish(continued=continued))
            except OSError:  # a full disk must not reach the controller beside which this runs
                self._write_errors += 1
