"""Counts of all control ticks since the start of a gatekeeper, for observers such as `dualbrain metrics`.

Every count has a fixed place in a tuple of fixed length, so that no text of a scene, contract or client is part of it.
"""

from __future__ import annotations

from bisect import bisect_left
from math import isfinite
from typing import Annotated, get_args

import msgspec

from dualbrain.contracts.verdict import STAGES
from dualbrain.control.recording.trace import DEAD_BAND
from dualbrain.records import OutcomeClass
from dualbrain.safety.cbf.result import (
    LOWER,
    OBSTACLE,
    PACKED_ROW,
    SELF,
    SPEED,
    UPPER,
    USER,
    FilterResult,
    FilterStatus,
)
from dualbrain.safety.supervisor.actions import SafetyAction

DELTA_BOUNDS = (DEAD_BAND, 1e-3, 1e-2, 0.03, 0.1, 0.3, 1.0)
"""Upper bounds of the bins of δ; one more bin counts larger values, and ticks whose δ is not a number."""
CLEARANCE_BOUNDS = (0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2)
"""Upper bounds of the bins of the smallest barrier value h [m]; one more bin counts larger values."""
CONSTRAINT_KINDS = ("obstacle", "self_collision", "control_bound", "extra_row", "speed_limit")
"""Kinds of constraints that can be binding; a control bound is that of position, velocity, acceleration or jerk."""
_KIND_OF_ROW = {OBSTACLE: 0, SELF: 1, LOWER: 2, UPPER: 2, USER: 3, SPEED: 4}
VERDICTS = ("accepted", *(f"rejected_{stage}" for stage in STAGES), "not_considered")
"""Verdicts on proposed contracts; one that was not considered was never parsed."""
OUTCOMES: tuple[OutcomeClass, ...] = get_args(OutcomeClass)
"""Outcomes of contracts."""

Count = Annotated[int, msgspec.Meta(ge=0)]
LENGTHS = {
    "filter_status": len(FilterStatus),
    "actions": len(SafetyAction),
    "binding": len(CONSTRAINT_KINDS),
    "delta": len(DELTA_BOUNDS) + 1,
    "clearance": len(CLEARANCE_BOUNDS) + 1,
    "verdicts": len(VERDICTS),
    "outcomes": len(OUTCOMES),
}
"""Length of each tuple of `TickCounts`."""


class TickCounts(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Counts since the start of the gatekeeper; a tuple counts by position in the list of the same meaning.

    `contract_ticks`: ticks of contracts. `interventions`: ticks with δ above the dead band. `late`: ticks that took too
    long; `missed`: joint states that never arrived. By position: ticks by `filter_status` (`FilterStatus`) and by
    supervisor action (`SafetyAction`), ticks in which a constraint of each kind was `binding` (`CONSTRAINT_KINDS`),
    ticks by bin of `delta` and of `clearance` h [m], proposed contracts by verdict (`VERDICTS`) and executed ones by
    outcome (`OUTCOMES`). `delta_sum` and `clearance_sum` [m] sum the finite values; `h_min` [m] is the newest h, None
    if the filter refused its input.
    """

    ticks: Count
    contract_ticks: Count
    interventions: Count
    late: Count
    missed: Count
    filter_status: tuple[Count, ...]
    actions: tuple[Count, ...]
    binding: tuple[Count, ...]
    delta: tuple[Count, ...]
    delta_sum: float
    clearance: tuple[Count, ...]
    clearance_sum: float
    verdicts: tuple[Count, ...]
    outcomes: tuple[Count, ...]
    h_min: float | None

    def __post_init__(self) -> None:
        """Raise `ValueError` for a tuple of another length: its positions would have another meaning."""
        for name, length in LENGTHS.items():
            if len(getattr(self, name)) != length:
                raise ValueError(f"{name} has {len(getattr(self, name))} counts, expected {length}")


class TickCounter:
    """Counts the ticks of one control loop; only the thread of the loop may call it."""

    def __init__(self) -> None:
        """Start at zero."""
        self._ticks = self._contract_ticks = self._interventions = 0
        self._filter_status, self._actions = [0] * len(FilterStatus), [0] * len(SafetyAction)
        self._binding = [0] * len(CONSTRAINT_KINDS)
        self._delta, self._delta_sum = [0] * (len(DELTA_BOUNDS) + 1), 0.0
        self._clearance, self._clearance_sum = [0] * (len(CLEARANCE_BOUNDS) + 1), 0.0
        self._verdicts, self._outcomes = dict.fromkeys(VERDICTS, 0), dict.fromkeys(OUTCOMES, 0)
        self._h_min: float | None = None

    def count_tick(self, result: FilterResult, action: SafetyAction, *, in_contract: bool) -> None:
        """Count one tick: the result of the filter, the supervisor's action, and whether a contract runs."""
        self._ticks += 1
        self._contract_ticks += in_contract
        self._filter_status[result.status] += 1
        self._actions[action] += 1
        delta, h = result.delta, result.h_min
        self._interventions += not delta <= DEAD_BAND
        if isfinite(delta):
            self._delta[bisect_left(DELTA_BOUNDS, delta)] += 1
            self._delta_sum += delta
        else:
            self._delta[-1] += 1
        self._h_min = h if isfinite(h) else None
        if isfinite(h):
            self._clearance[bisect_left(CLEARANCE_BOUNDS, h)] += 1
            self._clearance_sum += h
        if result.packed_rows:
            for kind in {_KIND_OF_ROW[row[0]] for row in PACKED_ROW.iter_unpack(result.packed_rows)}:
                self._binding[kind] += 1

    def count_verdict(self, verdict: str) -> None:
        """Count one of `VERDICTS`."""
        self._verdicts[verdict] += 1

    def count_outcome(self, outcome: OutcomeClass) -> None:
        """Count the outcome of an executed contract."""
        self._outcomes[outcome] += 1

    def counts(self, late: int, missed: int) -> TickCounts:
        """The counts so far, with those of the tick timer."""
        return TickCounts(
            ticks=self._ticks,
            contract_ticks=self._contract_ticks,
            interventions=self._interventions,
            late=late,
            missed=missed,
            filter_status=tuple(self._filter_status),
            actions=tuple(self._actions),
            binding=tuple(self._binding),
            delta=tuple(self._delta),
            delta_sum=self._delta_sum,
            clearance=tuple(self._clearance),
            clearance_sum=self._clearance_sum,
            verdicts=tuple(self._verdicts.values()),
            outcomes=tuple(self._outcomes.values()),
            h_min=self._h_min,
        )
