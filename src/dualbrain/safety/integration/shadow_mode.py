"""Shadow mode: the filter evaluates the commands of a controller without changing them, and reports interventions."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from math import inf, isfinite

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.validation import as_real_array, check_real
from dualbrain.core.text import count_noun
from dualbrain.errors import ConfigurationError
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.result import OBSTACLE, SELF, FilterResult, FilterStatus, Reason
from dualbrain.safety.integration.intervention_log import InterventionInterval, OpenInterval

Array = NDArray[np.float64]

DEAD_BAND = 1e-4
"""A delta up to this is rounding of the kernel and counts as unchanged."""
MAX_COMMAND_AGE = 0.1
"""Time without a call [s] after which the last command is no longer in force."""
REFUSED_REASONS = int(
    Reason.BAD_INPUT | Reason.STALE_STATE | Reason.STALE_SCENE | Reason.OUTSIDE_LIMITS | Reason.BAD_SCENE
)
"""Reasons for which the kernel computes no distances, so that `h_min` is undefined."""


class ShadowTick(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """Result of one tick at `now` [s]; `h_min` [m] is None if the filter rejected the input.

    `nearest` names the pair with the smallest h. It is determined in changed ticks and at a new minimum of h, else "".
    """

    now: float
    delta: float
    status: FilterStatus
    h_min: float | None
    nearest: str


class ShadowSummary(msgspec.Struct, frozen=True, kw_only=True):
    """Summary of a session in shadow mode.

    - `changed_ticks` of `ticks`: ticks in which the filter would have changed the control. `refused_ticks`: ticks with
      an input that the filter rejects. `late_calls`: calls more than half a period late.
    - `Delta`: mean of delta. `by_status`: number of ticks by status.
    - `min_h_tick`, `max_delta_tick`: ticks with the smallest h and the largest delta (None if there are none).
    - `intervals`: number of intervals, with a total `intervention_time` [s]. `write_errors`: intervals that could not
      be written.
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
        """Fraction of ticks that the filter would have changed."""
        return self.changed_ticks / self.ticks if self.ticks else 0.0

    def explain(self) -> str:
        """Summary in a few sentences."""
        if not self.ticks:
            return "No ticks were observed."
        words = [
            f"{self.ticks} ticks observed; the filter would have changed {self.changed_fraction:.2%} of them,"
            f" in {count_noun(self.intervals, 'interval')} of {self.intervention_time:.2f} s in total;"
            f" Δ {self.Delta:.4f}."
        ]
        if self.min_h_tick and self.min_h_tick.h_min is not None:
            pair = f" ({self.min_h_tick.nearest})" if self.min_h_tick.nearest else ""
            words.append(f"Smallest h: {self.min_h_tick.h_min * 1e3:.1f} mm at {self.min_h_tick.now:.3f} s{pair}.")
        if (tick := self.max_delta_tick) is not None:
            words.append(f"Largest change in one period: {tick.delta:.1%} of full speed at {tick.now:.3f} s.")
        if self.refused_ticks:
            words.append(f"The filter rejected the input of {self.refused_ticks} ticks: fix this first.")
        if self.late_calls:
            words.append(f"{self.late_calls} calls were late: check that robot model and controller have one period.")
        if self.write_errors:
            words.append(f"{self.write_errors} intervals could not be written.")
        return " ".join(words)


class ShadowFilter:
    """Evaluates the commands of a controller with a `SafetyFilter` and changes nothing.

    Each tick is evaluated separately: the filter's last control is the command that the robot received, never the
    result of the filter. A result therefore means "this command would have become that command"; it is not the motion
    that would have followed, because the first change would have led to other states. Two consequences:

    - A delta is at most the change that acceleration limits allow in one period. The duration of an interval and the
      decrease of h are more informative than its peak.
    - A controller that already exceeds the speed of a row cannot be corrected within one period. Such ticks are
      RELAXED, although an active filter would have slowed the robot down in time.

    Memory is bounded: sums, the last `history` ticks (`recent`), and the open interval.
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
        """Observe with `safety`, which must have no other caller; set obstacles with `safety.observe` as usual.

        `on_interval` receives every closed interval (it may be an `InterventionLog`). Changes less than `merge_gap` [s]
        apart form one interval; long intervals are reported in pieces of `max_duration` [s]. A delta up to `dead_band`
        counts as unchanged.

        Raises:
            ConfigurationError: the filter has jerk limits, which need two past commands.
        """
        if safety.config.jerk_limits:
            raise ConfigurationError.stating(
                "Shadow mode cannot use jerk limits, because each tick is evaluated from a single past command.",
                fix="Set FilterConfig.jerk_limits to False.",
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
        self,
        q: Array,
        v: Array,
        u_nom: Array,
        now: float,
        *,
        u_prev: Array | None = None,
        opening: float | None = None,
    ) -> FilterResult:
        """Result of the filter for the command `u_nom` (n,) [rad/s] at joint angles q and velocities v at `now` [s].

        `u_prev` is the velocity command in force until now. By default it is the `u_nom` of the previous call, or v at
        the start and after a pause of 0.1 s. Pass it if the drive received another command, e.g. from a rate limiter.
        Without the `opening` [m] of each finger, the fingers cover every opening.
        """
        n = self.safety.robot_model.n
        q = as_real_array("q of a step", q, (self.safety.robot_model.nq,)).copy()
        v, u_nom = (
            as_real_array(f"{name} of a step", values, (n,)).copy() for name, values in (("v", v), ("u_nom", u_nom))
        )
        if u_prev is not None:
            u_prev = as_real_array("u_prev", u_prev, (n,))
        now = check_real("now of a step", now)
        moment = now if isfinite(now) else max(0.0, self._now)
        if moment < self._now:  # the clock was reset: a new session
            self.reset()
        previous = self._previous_command(v, moment, u_prev)
        self.safety.reset(previous)
        result = self.safety(q, v, u_nom, now, opening=opening)
        self._late += 1.5 * self.safety.robot_model.period < moment - self._now < inf
        self._now, self._u_prev = moment, u_nom
        self._record(result, moment, previous)
        return result

    def reset(self) -> None:
        """Start a new session: close the open interval and clear the last command."""
        if self._interval:
            self._close_interval(self._interval)
        self._u_prev, self._now = None, -inf

    def close(self) -> ShadowSummary:
        """Close the open interval and return the summary; the caller closes the log of `on_interval`."""
        if self._interval:
            self._close_interval(self._interval)
        return self.summary()

    def summary(self) -> ShadowSummary:
        """Summary so far, without the open interval."""
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

    # --- internals ----------------------------------------------------------------------------------------------

    def _previous_command(self, v: Array, now: float, u_prev: Array | None) -> Array:
        """The last command, clipped to the velocity limits and finite."""
        if u_prev is None:
            fresh = now - self._now <= max(MAX_COMMAND_AGE, 2.0 * self.safety.robot_model.period)
            u_prev = self._u_prev if fresh and self._u_prev is not None else v
        if not np.isfinite(u_prev).all():
            u_prev = np.where(np.isfinite(u_prev), u_prev, np.where(np.isfinite(v), v, 0.0))
        return np.minimum(np.maximum(u_prev, -self._v_max), self._v_max)

    def _record(self, result: FilterResult, now: float, u_prev: Array) -> None:
        refused = result.flags & REFUSED_REASONS != 0
        changed = result.delta > self._dead_band or result.status > FilterStatus.MODIFIED
        deepest = not refused and result.h_min < self._h_min
        nearest = self._nearest_pair() if (changed or deepest) and not refused else ""
        tick = ShadowTick(
            now=now,
            delta=result.delta,
            status=result.status,
            h_min=None if refused else result.h_min,
            nearest=nearest,
        )
        self.recent.append(tick)
        self._ticks, self._changed, self._refused = self._ticks + 1, self._changed + changed, self._refused + refused
        self._sum += result.delta
        self._by_status[result.status] += 1
        if deepest:
            self._min_h_tick, self._h_min = tick, result.h_min
        if changed and (self._max_delta_tick is None or tick.delta > self._max_delta_tick.delta):
            self._max_delta_tick = tick
        self._update_interval(tick, changed, result, u_prev)

    def _nearest_pair(self) -> str:
        """Name of the pair with the smallest h among the rows of the last step."""
        pairs = [row for row in self.safety.rows() if row.kind in (OBSTACLE, SELF)]
        return min(pairs, key=lambda row: row.h).name if pairs else ""

    def _update_interval(self, tick: ShadowTick, changed: bool, result: FilterResult, u_prev: Array) -> None:
        """Open, extend or close an interval."""
        if self._interval and tick.now - self._interval.end > self._merge_gap:
            self._close_interval(self._interval)
        if not changed:
            return
        if self._interval and tick.now - self._interval.start >= self._max_duration:
            self._close_interval(self._interval, continued=True)
        if self._interval is None:
            self._interval = OpenInterval(tick.now)
        self._interval.add(tick.now, result, tick.h_min, result.limiting_row)

    def _close_interval(self, interval: OpenInterval, *, continued: bool = False) -> None:
        self._interval = None
        self._intervals += 1
        self._intervention_time += interval.end - interval.start + self.safety.robot_model.period
        if self._on_interval:
            try:
                self._on_interval(interval.finish(continued=continued))
            except OSError:  # a full disk must not stop the observed controller
                self._write_errors += 1
