"""What the filter of a control-affine system answers, and why."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.safety.cbf.result import FilterStatus, Reason
from dualbrain.safety.cbf.rows import Rank

Array = NDArray[np.float64]


class FilteredControl(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """One answer of `ControlAffineFilter`: `u` (m,), always finite and in the box.

    `names`, `h` and `psi` belong together, one for each barrier; `psi` holds ψ_0 = h to ψ_{r−1}. `outside` names the
    barriers with a ψ below zero: for them the initial condition of the promise does not hold. `active` are the binding
    constraints as (name, multiplier), the conflicting ones when the status is RELAXED; `given_up` the ranks of which
    some row could not be met. `delta` is the root mean square of (u − u_nom) in units of half the box.
    """

    u: Array
    u_nom: Array
    status: FilterStatus
    names: tuple[str, ...]
    reason: Reason = Reason(0)
    delta: float = 0.0
    psi: tuple[tuple[float, ...], ...] = ()
    active_rows: tuple[tuple[str, float], ...] = ()
    relaxed_ranks: tuple[Rank, ...] = ()
    iterations: int = 0

    @property
    def h(self) -> tuple[float, ...]:
        """The barriers' values; empty where the state could not be read."""
        return tuple(chain[0] for chain in self.psi)

    @property
    def violated_barriers(self) -> tuple[str, ...]:
        """Barriers with a ψ below zero."""
        return tuple(name for name, chain in zip(self.names, self.psi, strict=False) if min(chain) < 0.0)

    @property
    def certified(self) -> bool:
        """Every premise of the promise held at this state: no ψ is below zero and every row is met."""
        return self.status <= FilterStatus.MODIFIED and not self.violated_barriers

    def explain(self) -> str:
        """One sentence for people."""
        who = " and ".join(name for name, _ in sorted(self.active_rows, key=lambda row: -row[1])[:2])
        if self.status is FilterStatus.SAFE:
            said = "passed unchanged"
        elif self.status is FilterStatus.MODIFIED:
            said = f"{who or 'limits'}: changed by {100.0 * self.delta:.1f} % of the range"
        else:
            causes = ", ".join(flag.name.lower().replace("_", " ") for flag in self.reason if flag.name)
            said = f"{self.status.name.lower()}: {causes}" + (f" ({who})" if who else "")
        return said + (
            f"; outside the safe set of {', '.join(self.violated_barriers)}" if self.violated_barriers else ""
        )
