"""Result of the filter of a control-affine system, and the reasons for it."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.safety.cbf.result import FilterStatus
from dualbrain.safety.cbf.rows import Rank
from dualbrain.safety.stop_cause import Reason, StopCause, stop_cause, stop_remedy

Array = NDArray[np.float64]


class FilteredControl(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """Result of `ControlAffineFilter`: `u` (m,), always finite and in the box.

    `names`, `h` and `psi` have one entry per barrier; `psi` holds ψ_0 = h to ψ_{r−1}. `violated_barriers` have a ψ
    below zero, so that the initial condition of the guarantee does not hold for them. `active_rows` are the binding
    constraints as (name, multiplier), or the conflicting constraints if the status is RELAXED. `relaxed_ranks` are the
    ranks of which some row was relaxed. `delta` is the root mean square of (u − u_nom) in units of half the box.
    `detail` states the numbers behind a stop.
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
    detail: str = ""

    @property
    def h(self) -> tuple[float, ...]:
        """The barrier values; empty if the filter rejected the state."""
        return tuple(chain[0] for chain in self.psi)

    @property
    def violated_barriers(self) -> tuple[str, ...]:
        """Names of the barriers with a ψ below zero."""
        return tuple(name for name, chain in zip(self.names, self.psi, strict=False) if min(chain) < 0.0)

    @property
    def certified(self) -> bool:
        """Whether the conditions of the guarantee hold at this state: no ψ is below zero and every row is met."""
        return self.status <= FilterStatus.MODIFIED and not self.violated_barriers

    @property
    def cause(self) -> StopCause | None:
        """The cause of STOPPED; None for other statuses."""
        return stop_cause(int(self.reason)) if self.status >= FilterStatus.STOPPED else None

    def explain(self) -> str:
        """One sentence for people; for STOPPED with the cause, its numbers, and what to do."""
        rows = " and ".join(name for name, _ in sorted(self.active_rows, key=lambda row: -row[1])[:2])
        if self.status is FilterStatus.SAFE:
            text = "passed unchanged"
        elif self.status is FilterStatus.MODIFIED:
            text = f"{rows or 'limits'}: changed by {100.0 * self.delta:.1f} % of the range"
        else:
            causes = ", ".join(flag.name.lower().replace("_", " ") for flag in self.reason if flag.name)
            text = f"{self.status.name.lower()}: {causes}" + (f" ({rows})" if rows else "")
        if self.status >= FilterStatus.STOPPED:
            return "; ".join(filter(None, (text, self.detail, stop_remedy(int(self.reason)))))
        violated = ", ".join(self.violated_barriers)
        return f"{text}; outside the safe set of {violated}" if violated else text
