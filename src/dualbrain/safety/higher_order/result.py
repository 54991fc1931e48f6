"""Result of the acceleration filter, and the reasons for it."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.safety.cbf.result import FilterStatus
from dualbrain.safety.cbf.rows import Rank
from dualbrain.safety.stop_cause import Reason, StopCause, stop_cause, stop_remedy

Array = NDArray[np.float64]


class FilteredAcceleration(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """Result of `AccelerationFilter`: `u` (n,) [rad/s²], always finite and within the acceleration limits.

    `delta` = sqrt((u − u_nom)' W (u − u_nom)), W = diag(1/a_max²)/n. `h_min` [m] and `psi_min` [m/s] are the smallest
    h and ψ₁ = ḣ + α₁ h of all pairs. `active_rows` are the binding rows as (name, multiplier), or the conflicting rows
    if the status is RELAXED. `penetrating_pairs` have h < 0, `too_fast_pairs` have ψ₁ < 0, so that the initial
    condition of the guarantee does not hold for them. `relaxed_ranks` are the ranks of which some row was relaxed.
    `detail` states the numbers behind a stop.
    """

    u: Array
    u_nom: Array
    status: FilterStatus
    reason: Reason = Reason(0)
    delta: float = 0.0
    h_min: float = np.inf
    psi_min: float = np.inf
    active_rows: tuple[tuple[str, float], ...] = ()
    penetrating_pairs: tuple[str, ...] = ()
    too_fast_pairs: tuple[str, ...] = ()
    relaxed_ranks: tuple[Rank, ...] = ()
    n_rows: int = 0
    iterations: int = 0
    detail: str = ""

    @property
    def certified(self) -> bool:
        """Whether the conditions of the guarantee hold in this step: the state is safe and every row is met."""
        return self.status <= FilterStatus.MODIFIED and not self.penetrating_pairs and not self.too_fast_pairs

    @property
    def cause(self) -> StopCause | None:
        """The cause of STOPPED; None for other statuses."""
        return stop_cause(int(self.reason)) if self.status >= FilterStatus.STOPPED else None

    def explain(self) -> str:
        """One sentence for people: the closest pair, and how the filter changed the control.

        For STOPPED it states the cause, its numbers, and what to do.
        """
        head = self._describe_change()
        if self.status >= FilterStatus.STOPPED:
            return "; ".join(filter(None, (head, self.detail, stop_remedy(int(self.reason)))))
        if self.too_fast_pairs:
            head += f"; too fast toward {_join_names(self.too_fast_pairs)}"
        return f"{head}; already inside {_join_names(self.penetrating_pairs)}" if self.penetrating_pairs else head

    def _describe_change(self) -> str:
        if self.status is FilterStatus.SAFE:
            return "passed unchanged" + self._describe_nearest()
        rows = _join_names(tuple(name for name, _ in sorted(self.active_rows, key=lambda row: -row[1])))
        if self.status is FilterStatus.MODIFIED:
            return (
                f"{rows or 'limits'}: changed by {100.0 * self.delta:.1f} % of full acceleration"
                + self._describe_nearest()
            )
        causes = ", ".join(flag.name.lower().replace("_", " ") for flag in self.reason if flag.name)
        return f"{self.status.name.lower()}: {causes or 'braking'}" + (f" ({rows})" if rows else "")

    def _describe_nearest(self) -> str:
        return f", nearest pair at {self.h_min * 1e3:.0f} mm" if np.isfinite(self.h_min) else ""


def _join_names(names: tuple[str, ...]) -> str:
    """The first two names and the number of further names."""
    names = tuple(dict.fromkeys(names))
    more = f" and {len(names) - 2} more" if len(names) > 2 else ""
    return (" and " if not more else ", ").join(names[:2]) + more
