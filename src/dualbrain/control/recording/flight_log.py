"""The flight log: the control loop's only output, which feeds the trace in memory and the recorder on disk."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualbrain.control.recording.recorder import Recorder
from dualbrain.control.recording.trace import DEAD_BAND, FULL_INTERVENTION, Event, EventKind, Trace
from dualbrain.records import ActionResult, Attempt, Outcome, OutcomeClass, Scene
from dualbrain.robots.interface import RobotState
from dualbrain.safety.cbf.filter import FilterResult
from dualbrain.safety.cbf.rows import ConstraintRow

Array = NDArray[np.float64]


TABLE_OF_CALL = {"attach": "grasp", "detach": "grasp"}
"""Table of the filter that a call replaces, where its name is another one."""
TABLE_ORDER = ("constrain", "grasp", "observe", "permit")
"""Tables of the filter in the order in which they are set again; permits refer to obstacles."""
RECENT_TIME, MAX_CONSTRAINTS = 3.0, 2
"""Constraint rows that were active within this time [s] before the end of an action are named; at most so many."""


class FlightLog:
    """Trace and recorder behind one interface; the recorder may be absent, for example in an evaluation."""

    def __init__(
        self,
        trace: Trace,
        recorder: Recorder | None = None,
        on_event: Callable[[Event], None] | None = None,
        on_attempt: Callable[[Attempt], None] | None = None,
    ) -> None:
        """Write to `trace` and, if given, to `recorder`; `on_event` and `on_attempt` get each one when it happens.

        `binding` counts, for each barrier, the ticks of actions in which it was active.
        """
        self.trace, self.recorder, self._on_event, self._on_attempt = trace, recorder, on_event, on_attempt
        self.binding: Counter[str] = Counter()
        self._last_binding: tuple[float, FilterResult] | None = None
        self._rows: tuple[ConstraintRow, ...] = ()
        self._tables: dict[str, tuple[str, dict[str, Any]]] = {}
        self._paused = False

    @property
    def recording_failure(self) -> str:
        """Why ticks are or may be lost in the recording, as a sentence; "" if they are not, or if nothing records."""
        return self.recorder.failure if self.recorder else ""

    def pause(self, t: float, reason: str) -> None:
        """Record no ticks, calls and scenes from now on, only events; the recording states the `reason`."""
        if self.recorder and not self._paused:
            self.note(t, "recorder", f"the recording pauses: {reason}")
            self._paused = True

    def resume(self, t: float) -> bool:
        """End a pause; returns whether there was one. The newest tables of the filter are recorded again.

        The caller then resets the memory of the filter and logs that as the call "reset", so that a replay is exact.
        """
        if not self._paused:
            return False
        self._paused = False
        self.note(t, "recorder", "the recording continues")
        for kind in TABLE_ORDER:
            if kind in self._tables:
                name, arguments = self._tables[kind]
                self.call(t, name, **arguments)
        return True

    def tick(
        self,
        now: float,
        state: RobotState,
        u_nom: Array,
        result: FilterResult,
        action: int,
        phase: str,
        *,
        order: int = 0,
        scale_applied: float = 1.0,
    ) -> None:
        """Log one control tick; `order` and `scale_applied` are the supervisor's action and the scale of u_nom."""
        row = self.trace.append(
            now, state, u_nom, result, action=action, phase=phase, order=order, scale_applied=scale_applied
        )
        if action >= 0 and result.binding_rows:
            self.binding.update(result.barriers)
            self._last_binding = now, result
        if self.recorder and not self._paused:
            self.recorder.tick(row)

    def call(self, t: float, name: str, **arguments: Any) -> None:
        """Log a call that changes the filter's tables, so that a replay can repeat it."""
        if self.recorder:
            self._tables[TABLE_OF_CALL.get(name, name)] = name, arguments
            if not self._paused:
                self.recorder.call(t, name, **arguments)

    def extra_rows(self, t: float, rows: tuple[ConstraintRow, ...]) -> None:
        """Log the rows of live barriers, if they are not those of the last tick."""
        if rows != self._rows:
            self._rows = rows
            self.call(t, "constrain", rows=rows)

    def note(self, t: float, kind: EventKind, text: str, **data: Any) -> None:
        """Log an event for people."""
        event = self.trace.note(t, kind, text, **data)
        if self.recorder:
            self.recorder.event(event)
        if self._on_event:
            self._on_event(event)

    def scene(self, scene: Scene) -> None:
        """Log a perceived scene."""
        if self.recorder and not self._paused:
            self.recorder.scene(scene)

    def thread_ticks(self, t: float, records: NDArray[Any]) -> None:
        """Log ticks of a control thread."""
        if self.recorder and not self._paused:
            self.recorder.thread_ticks(t, records)

    def attempt(self, t: float, attempt: Attempt) -> None:
        """Log a proposal of the planner with the gate's verdict."""
        if self.recorder:
            self.recorder.attempt(t, attempt)
        if self._on_attempt:
            self._on_attempt(attempt)

    def mean_delta(self, first: int) -> float:
        """Mean δ_t over the ticks from index `first` on; 0 without ticks (paper 4.4)."""
        delta = self.trace["delta"][first:]
        return float(np.mean(delta)) if len(delta) else 0.0

    def outcome(self, kind: OutcomeClass, reason: str, first: int, actions: tuple[ActionResult, ...]) -> Outcome:
        """The outcome of the segment that began at tick `first`; only ticks of its actions count."""
        chosen = np.flatnonzero(self.trace["action"][first:] >= 0) + first
        if kind == "declined" or not len(chosen):
            return Outcome(kind=kind, reason=reason, actions=actions)
        delta, h, t = (self.trace[name][chosen] for name in ("delta", "h_min", "t"))
        delta = np.nan_to_num(delta, nan=FULL_INTERVENTION)
        h = h[~np.isnan(h)]  # h is NaN in a tick whose input the filter refused
        return Outcome(
            kind=kind,
            reason=reason,
            Delta=float(delta.mean()),
            Delta_sum=float(delta.sum()),
            delta_peak=float(delta.max()),
            intervention_frequency=float(np.mean(delta > DEAD_BAND)),
            h_min=float(h.min()) if len(h) else None,
            duration=float(t[-1] - t[0]),
            actions=actions,
            active_constraints=self._active_constraints(float(t[-1]), actions),
        )

    def _active_constraints(self, end: float, actions: tuple[ActionResult, ...]) -> str:
        """The rows that were active within `RECENT_TIME` of `end` [s], strongest first; "" if every action was done."""
        if (
            self._last_binding is None
            or end - self._last_binding[0] > RECENT_TIME
            or all(one.status == "done" for one in actions)
        ):
            return ""
        rows = sorted(self._last_binding[1].active_rows, key=lambda row: -row[2])
        return " and ".join(dict.fromkeys(name for name, _, _ in rows[:MAX_CONSTRAINTS]))
