"""The trace: inputs and outputs of every control tick in memory, from which Δ, plots and recordings are made."""

from __future__ import annotations

from dataclasses import dataclass
from math import nan
from struct import Struct
from typing import Any, Literal, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import UnknownNameError
from dualbrain.robots.interface import RobotState

Array = NDArray[np.float64]

FULL_INTERVENTION = 2.0
"""δ of a tick in which nothing remains of the nominal control, or whose δ could not be computed."""
DEAD_BAND = 1e-4
"""δ at or below this counts as no intervention: the kernel's rounding in float32, 0.01 % of full speed."""

WRENCH_LENGTH = 6
NO_WRENCH = (nan,) * WRENCH_LENGTH

BLOCK_ROWS = 4096
"""Rows of one preallocated block of a trace."""

EventKind = Literal[
    "verdict",
    "action",
    "phase",
    "intervention",
    "takeover",
    "perception",
    "planner",
    "memory",
    "fault",
    "recorder",
    "order",
    "operator",
    "margin",
    "command_lost",
    "target",
    "control_thread",
    "site",
]


class Event(msgspec.Struct, frozen=True):
    """An event of `kind` at `t` [s]: `text` for people, `data` for programs."""

    t: float
    kind: EventKind
    text: str
    data: dict[str, Any] = {}


class LoggedResult(Protocol):
    """The fields of a filter result that are logged (paper 4.3, 4.4)."""

    @property
    def u(self) -> Array:
        """Control (n,) [rad/s]."""
        ...

    @property
    def status(self) -> int:
        """Code of the filter's status, a value of `FilterStatus`."""
        ...

    @property
    def delta(self) -> float:
        """Intervention δ_t."""
        ...

    @property
    def delta_rows(self) -> float:
        """Part of δ_t that the barrier rows caused."""
        ...

    @property
    def delta_box(self) -> float:
        """Part of δ_t that the control bounds caused."""
        ...

    @property
    def h_min(self) -> float:
        """Least barrier value [m]."""
        ...

    @property
    def certified(self) -> bool:
        """Whether the control is certified safe for one period."""
        ...

    @property
    def iterations(self) -> int:
        """Iterations of the QP solver."""
        ...

    @property
    def n_rows(self) -> int:
        """Number of rows of the QP."""
        ...

    @property
    def delta_supervisor(self) -> float:
        """Part of δ_t that the supervisor caused."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Span:
    """Consecutive ticks `first` to `last` (inclusive) with the same `code`, from `start` to `end` [s]."""

    code: int
    first: int
    last: int
    start: float
    end: float


@dataclass(frozen=True, slots=True, kw_only=True)
class InterventionSummary:
    """Δ(τ) and related quantities of one segment (paper 4.4); `Delta` and `h_min` are None without ticks."""

    ticks: int
    duration: float
    Delta: float | None
    Delta_sum: float
    delta_peak: float
    intervention_frequency: float
    h_min: float | None


def columns(n: int, width: int | None = None) -> dict[str, slice]:
    """Position of each quantity in a logged row, for `n` joints and configurations of length `width` (default: n).

    Inputs of the filter: `t` (its `now`) [s], the state's `stamp` [s], `sequence`, `q` [rad], `v` [rad/s], finger
    `opening` [m] (NaN if it is unknown), finger `forces` [N], `drive`, motor `torques` [Nm] and `wrench` at the wrist
    [N, Nm] (NaN if they are not measured), and `u_nom` [rad/s]. Its outputs: `u` [rad/s],
    `delta`, `delta_rows`, `delta_box`, `h_min` [m], `status`, `certified`, `iterations`, `n_rows`. Of the supervisor:
    `delta_supervisor`, the `order` (`SafetyAction` as a number) and `touched`: the scale of u_nom, −1 for a standstill,
    −2 for braking instead of the filter. Then the `action` index and `phase` code.
    """
    widths = {
        "t": 1,
        "stamp": 1,
        "sequence": 1,
        "q": width or n,
        "v": n,
        "opening": 1,
        "forces": 2,
        "drive": 1,
        "torques": n,
        "wrench": WRENCH_LENGTH,
        "u_nom": n,
    }
    widths |= {"u": n, "delta": 1, "delta_rows": 1, "delta_box": 1, "h_min": 1, "status": 1, "certified": 1}
    widths |= {"iterations": 1, "n_rows": 1, "delta_supervisor": 1, "order": 1, "touched": 1, "action": 1, "phase": 1}
    ends = np.cumsum(list(widths.values())).tolist()
    return {name: slice(end - width, end) for (name, width), end in zip(widths.items(), ends, strict=True)}


def spans(codes: Array, t: Array) -> list[Span]:
    """Runs of equal values in `codes` (ticks,); each ends at the time [s] at which the next begins."""
    if not len(codes):
        return []
    starts = np.flatnonzero(np.r_[True, codes[1:] != codes[:-1]]).tolist()
    after = [*starts[1:], len(codes)]
    return [
        Span(
            code=int(codes[first]), first=first, last=end - 1, start=float(t[first]), end=float(t[min(end, len(t) - 1)])
        )
        for first, end in zip(starts, after, strict=True)
    ]


class Trace:
    """A growing log of ticks in preallocated blocks of float64 rows, and a list of events.

    Appending never moves old rows: the cost of a tick is constant, and a returned row remains valid. All logged values
    are exact in float64 (the kernel's float32 control included).
    """

    def __init__(self, n: int, width: int | None = None) -> None:
        """A log for a robot with `n` joints and configurations of length `width` (default: n)."""
        self.n, self.width = n, width
        self._no_torques = (nan,) * n
        self.columns = columns(n, width)
        self.phases: list[str] = []
        self.events: list[Event] = []
        self._width = self.columns["phase"].stop
        self._codes: dict[str, int] = {}
        self._full_blocks: list[Array] = []
        self._block: Array = np.zeros((BLOCK_ROWS, self._width))
        self._used = 0
        self._cached_rows: Array = self._block[:0]
        self._stride = 8 * self._width
        self._pack = Struct(f"={self._width}d").pack_into

    def append(
        self,
        now: float,
        state: RobotState,
        u_nom: Array,
        result: LoggedResult,
        *,
        action: int,
        phase: str,
        order: int = 0,
        scale_applied: float = 1.0,
    ) -> Array:
        """Log one tick; returns its row (width,), which must not be written to."""
        if self._used == BLOCK_ROWS:
            self._full_blocks.append(self._block)
            self._block, self._used = np.zeros((BLOCK_ROWS, self._width)), 0
        code = self._codes.get(phase)
        self._pack(
            self._block.data,
            self._used * self._stride,
            now,
            state.stamp,
            state.sequence,
            *state.q.tolist(),
            *state.v.tolist(),
            nan if state.opening is None else state.opening,
            *state.finger_forces,
            state.drive_enabled,
            *(self._no_torques if state.torques is None else state.torques.tolist()),
            *(NO_WRENCH if state.wrench is None else state.wrench.tolist()),
            *u_nom.tolist(),
            *result.u.tolist(),
            result.delta,
            result.delta_rows,
            result.delta_box,
            result.h_min,
            result.status,
            result.certified,
            result.iterations,
            result.n_rows,
            result.delta_supervisor,
            order,
            scale_applied,
            action,
            self._register_phase(phase) if code is None else code,
        )
        self._used += 1
        return self._block[self._used - 1]

    def extend(self, rows: Array) -> None:
        """Append rows (k, width), as read from a recording."""
        head = self._block[: self._used]
        self._full_blocks += (
            [head, np.asarray(rows, dtype=np.float64)] if self._used else [np.asarray(rows, np.float64)]
        )
        self._block, self._used = np.zeros((BLOCK_ROWS, self._width)), 0

    def clear(self) -> None:
        """Drop all ticks and events, so that a loop can run for days. Phase codes and returned rows remain valid."""
        self.events.clear()
        self._full_blocks, self._used = [], 0
        self._block = np.zeros((BLOCK_ROWS, self._width))
        self._cached_rows = self._block[:0]

    def note(self, t: float, kind: EventKind, text: str, **data: Any) -> Event:
        """Log one event."""
        event = Event(t, kind, text, data)
        self.events.append(event)
        return event

    def _register_phase(self, phase: str) -> int:
        self._codes[phase] = len(self.phases)
        self.phases.append(phase)
        return self._codes[phase]

    def __len__(self) -> int:
        """Number of ticks."""
        return sum(map(len, self._full_blocks)) + self._used

    @property
    def rows(self) -> Array:
        """All ticks, shape (ticks, width)."""
        if len(self._cached_rows) != len(self):
            self._cached_rows = np.concatenate([*self._full_blocks, self._block[: self._used]])
        return self._cached_rows

    def __getitem__(self, name: str) -> Array:
        """One quantity over all ticks: (ticks,) for scalars, (ticks, k) for vectors.

        Only its column is copied: a copy of all rows of a minute takes a tenth of a second, in which no tick runs.

        Raises `UnknownNameError` if there is no such column.
        """
        where = self.columns.get(name)
        if where is None:
            raise UnknownNameError("trace column", name, tuple(self.columns))
        chosen = where.start if where.stop - where.start == 1 else where
        if len(self._cached_rows) == len(self):
            return self._cached_rows[:, chosen]
        return np.concatenate([block[:, chosen] for block in (*self._full_blocks, self._block[: self._used])])

    def spans(self, name: str) -> list[Span]:
        """Runs of equal `action`, `phase` or `status`."""
        return spans(self[name], self["t"])

    def interventions(self, dead_band: float = DEAD_BAND) -> list[Span]:
        """Runs of ticks in which δ_t is above `dead_band`."""
        return [span for span in spans((self["delta"] > dead_band).astype(np.float64), self["t"]) if span.code]

    def summary(self, action: int | None = None, dead_band: float = DEAD_BAND) -> InterventionSummary:
        """Δ(τ) = mean δ_t, its sum and peak, the share of ticks with δ_t above `dead_band`, and the least h [m].

        Over all ticks, or over those of one `action`. A NaN counts as full intervention in δ and as −inf in h, because
        a control that was not computed is not known to be safe.
        """
        chosen = np.ones(len(self), bool) if action is None else self["action"] == action
        if not chosen.any():
            return InterventionSummary(
                ticks=0, duration=0.0, Delta=None, Delta_sum=0.0, delta_peak=0.0, intervention_frequency=0.0, h_min=None
            )
        t = self["t"][chosen]
        delta = np.nan_to_num(self["delta"][chosen], nan=FULL_INTERVENTION)
        h = np.nan_to_num(self["h_min"][chosen], nan=-np.inf, posinf=np.inf, neginf=-np.inf)
        frequency = float(np.mean(delta > dead_band))
        mean, total, peak = float(delta.mean()), float(delta.sum()), float(delta.max())
        return InterventionSummary(
            ticks=len(t),
            duration=float(t[-1] - t[0]),
            Delta=mean,
            Delta_sum=total,
            delta_peak=peak,
            intervention_frequency=frequency,
            h_min=float(h.min()),
        )
