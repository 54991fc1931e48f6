"""What the acceleration filter answers, and why."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.safety.cbf.result import FilterStatus, Reason
from dualbrain.safety.cbf.rows import Rank

Array = NDArray[np.float64]


class FilteredAcceleration(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """One answer of `AccelerationFilter`: `u` (n,) [rad/s²], always finite and within the acceleration limits.

    `delta` = sqrt((u − u_nom)' W (u − u_nom)), W = diag(1/a_max²)/n. `h_min` [m] and `psi_min` [m/s] are the smallest
    h and ψ₁ = ḣ + α₁ h of all pairs. `active` are the binding rows as (name, multiplier), the conflicting ones when the
    status is RELAXED. `inside` names pairs with h < 0, `too_fast` pairs with ψ₁ < 0: for them the initial condition of
    the promise does not hold. `given_up` are the ranks of which some row could not be met.
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

    @property
    def certified(self) -> bool:
        """Every premise of the promise held in this step: the state lies in the safe set and every row is met."""
        return self.status <= FilterStatus.MODIFIED and not self.penetrating_pairs and not self.too_fast_pairs

    def explain(self) -> str:
        """One sentence for people: what was near, and what was done about it."""
        head = self._describe_change()
        if self.too_fast_pairs:
            head += f"; too fast toward {_join_names(self.too_fast_pairs)}"
        return f"{head}; already inside {_join_names(self.penetrating_pairs)}" if self.penetrating_pairs else head

    def _describe_change(self) -> str:
        if self.status is FilterStatus.SAFE:
            return "passed unchanged" + self._describe_nearest()
        who = _join_names(tuple(name for name, _ in sorted(self.active_rows, key=lambda row: -row[1])))
        if self.status is FilterStatus.MODIFIED:
            return (
                f"{who or 'limits'}: changed by {100.0 * self.delta:.1f} % of full acceleration"
                + self._describe_nearest()
            )
        causes = ", ".join(flag.name.lower().replace("_", " ") for flag in self.reason if flag.name)
        return f"{self.status.name.lower()}: {causes or 'braking'}" + (f" ({who})" if who else "")

    def _describe_nearest(self) -> str:
        return f", nearest pair at {self.h_min * 1e3:.0f} mm" if np.isfinite(self.h_min) else ""


def _join_names(names: tuple[str, ...]) -> str:
    """The first two names, and how many more."""
    names = tuple(dict.fromkeys(names))
    more = f" and {len(names) - 2} more" if len(names) > 2 else ""
    return (" and " if not more else ", ").join(names[:2]) + more
