"""Result of the safety filter: a control that is always finite and admissible, and the reasons for it."""

from __future__ import annotations

from enum import IntEnum, StrEnum
from math import inf, sqrt
from struct import Struct

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.safety.cbf.rows import Rank
from dualbrain.safety.stop_cause import REASON_TEXTS, Evidence, Reason, describe_evidence, stop_cause, stop_remedy

Array = NDArray[np.float64]
RawRow = tuple[int, int, int, float, float]
PACKED_ROW = Struct("=3i2d")
"""Binary format of a binding row. Rows stay packed until they are read, because most results are never inspected."""
OBSTACLE, SELF, LOWER, UPPER, USER, SPEED = range(6)
"""Kinds of rows in the kernel's numbering."""
LIMIT_NAMES = ("velocity", "acceleration", "jerk", "position")
"""Sources of a bound of the box, in the kernel's numbering."""


class FilterStatus(IntEnum):
    """Outcome of a filter step, in the order of severity.

    - SAFE: u is u_nom.
    - MODIFIED: u is the closest safe control.
    - RELAXED: no control satisfies all rows; u violates them least. With `Reason.RETREAT` u evades an obstacle in time.
    - STOPPED: the input is invalid or stale, or a limit of the kernel was reached; u brakes.
    - FAULT: h ≥ 0 cannot be certified for the next step, even for braking.
    """

    SAFE = 0
    MODIFIED = 1
    RELAXED = 2
    STOPPED = 3
    FAULT = 4


class LimitKind(StrEnum):
    """The kind of limit that changed a control or an action the most.

    CONTACT is a pair of links, or of a link and an obstacle; CONSTRAINT a row of `SafetyFilter.constrain` or of a
    Python barrier. STOP means that the filter brakes for another reason (`FilterResult.cause`), INPUT that an action or
    a joint state cannot be used.
    """

    NONE = "none"
    JOINT_POSITION = "joint position"
    SPEED = "speed"
    CONTACT = "contact"
    CONSTRAINT = "constraint"
    STOP = "stop"
    INPUT = "input"


class RowNames(msgspec.Struct, frozen=True, kw_only=True):
    """Names for the indices of the kernel: the link of each sphere, the obstacles, and the joints.

    `barriers` are the barriers of the obstacles; `rows` are the rows of `SafetyFilter.constrain` and Python barriers.
    `refusal` is the reason why the last update of obstacles, rows or the grasped object was refused, "" if none was.
    """

    spheres: tuple[str, ...]
    obstacles: tuple[str, ...]
    joints: tuple[str, ...]
    v_max: tuple[float, ...]
    barriers: tuple[str, ...] = ()
    rows: tuple[str, ...] = ()
    refusal: str = ""

    def row_name(self, kind: int, i: int, j: int) -> str:
        """Name of a row: "hand vs 'cup'", "link5 vs link2", "hand speed limit", "panda_joint4 acceleration limit"."""
        if kind == OBSTACLE:
            return f"{self.link_of_sphere(i)} vs {self.obstacles[j]!r}"
        if kind == SELF:
            return f"{self.link_of_sphere(i)} vs {self.link_of_sphere(j)}"
        if kind == USER:
            return self.rows[i]
        if kind == SPEED:
            return f"{self.point_of_speed(i)} speed limit"
        return f"{self.joints[i]} {LIMIT_NAMES[j]} limit"

    def barrier_name(self, kind: int, i: int, j: int) -> str:
        """Name in `safety.barriers` of the barrier that a row belongs to."""
        if kind == OBSTACLE:
            return "held_object" if i >= len(self.spheres) else self.barriers[j]
        if kind == USER:
            return self.rows[i].partition(":")[0]
        if kind == SELF:
            return "self_collision"
        if kind == SPEED:
            return "cartesian_speed"
        return "joint_limits" if LIMIT_NAMES[j] == "position" else "joint_motion"

    def link_of_sphere(self, index: int) -> str:
        """Link of a sphere; "held" for spheres beyond those of the robot."""
        return self.spheres[index] if index < len(self.spheres) else "held"

    def point_of_speed(self, index: int) -> str:
        """The part of a speed limit: the link of a sphere, or "tool or load" for the last points.

        The tool is the point after the last sphere, so without a grasped object it has the index of the first sphere of
        one. Both move with the last frame.
        """
        return self.spheres[index] if index < len(self.spheres) else "tool or load"


class FilterResult(msgspec.Struct, frozen=True, eq=False, gc=False):  # numbers and tuples: no cycles
    """Result of one step of the filter.

    - `u` (n,) [rad/s]: the safe control. `u_nom` (n,): the nominal control.
    - `delta` = sqrt((u − u_nom)' W (u − u_nom)), W = diag(1/v_max²)/n (paper 4.4), split into `delta_rows`,
      `delta_box` and `delta_supervisor`, the part due to an action of the supervisor.
    - `h_min` [m]: smallest barrier value of all pairs without a permit; NaN if the filter rejected the input.
    - `certified`: h(y + dt u) ≥ 0, or no deeper than before.
    - `flags`: bits of `reason`. `iterations` of the QP. `n_rows`: number of rows in the QP.
    - `packed_rows`: the binding rows, see `binding_rows`. `relaxed_mask`: bit r is set if rows of rank r were relaxed.
    - `packed_evidence`: the numbers behind the reasons of STOPPED and FAULT, see `evidence`.
    """

    u: Array
    u_nom: Array
    names: RowNames
    status: FilterStatus
    flags: int
    delta: float
    delta_rows: float
    delta_box: float
    h_min: float
    certified: bool
    iterations: int
    n_rows: int
    packed_rows: bytes
    relaxed_mask: int = 0
    delta_supervisor: float = 0.0
    packed_evidence: tuple[tuple[int, int, int, int, float, float], ...] = ()

    @property
    def binding_rows(self) -> tuple[RawRow, ...]:
        """The binding rows with the kernel's indices: kind, i, j, h, multiplier; `active_rows` has their names."""
        return tuple(PACKED_ROW.iter_unpack(self.packed_rows))

    @property
    def relaxed_ranks(self) -> tuple[Rank, ...]:
        """The ranks of which some rows were relaxed."""
        return tuple(rank for rank in Rank if self.relaxed_mask >> rank & 1)

    @property
    def barriers(self) -> tuple[str, ...]:
        """Names in `safety.barriers` of the barriers that the binding rows belong to."""
        return tuple(dict.fromkeys(self.names.barrier_name(kind, i, j) for kind, i, j, _, _ in self.binding_rows))

    @property
    def obstacle_pairs(self) -> tuple[tuple[str, str, float], ...]:
        """Binding pairs with obstacles, the largest multiplier first: link, name of the obstacle, h [m]."""
        rows = sorted(self.binding_rows, key=lambda row: -row[4])
        names = self.names
        return tuple((names.link_of_sphere(i), names.obstacles[j], h) for kind, i, j, h, _ in rows if kind == OBSTACLE)

    @property
    def reason(self) -> Reason:
        """The reasons for a status above MODIFIED."""
        return Reason(self.flags)

    @property
    def active_rows(self) -> tuple[tuple[str, float, float], ...]:
        """Binding rows as (name, h [m], multiplier); if infeasible, the conflicting rows with Farkas multipliers."""
        return tuple((self.names.row_name(kind, i, j), h, weight) for kind, i, j, h, weight in self.binding_rows)

    @property
    def evidence(self) -> tuple[Evidence, ...]:
        """The numbers behind the reasons of STOPPED and FAULT; empty for other statuses."""
        return msgspec.convert(self.packed_evidence, tuple[Evidence, ...])

    @property
    def cause(self) -> str:
        """The cause of the result as a code: for STOPPED and FAULT a `StopCause`, which is a string.

        For other statuses it is the name of the row or reason with the largest effect (`limiting_row`), and empty if
        the control was not changed.
        """
        return stop_cause(self.flags) if self.status >= FilterStatus.STOPPED else self.limiting_row

    @property
    def limiting_row(self) -> str:
        """Name of the row with the largest effect; without rows the reasons; empty if the control was not changed."""
        if self.status > FilterStatus.MODIFIED and not self.binding_rows:
            return ", ".join(flag.name.lower().replace("_", " ") for flag in self.reason if flag.name)
        row = self._limiting()
        if row is None:
            return "" if self.status is FilterStatus.SAFE else "rounding"
        return self.names.row_name(*row[:3])

    @property
    def limit_kind(self) -> LimitKind:
        """The kind of limit of `limiting_row`; NONE if the control was not changed, or by rounding only."""
        row = self._limiting()
        if row is None:
            return LimitKind.STOP if self.status > FilterStatus.MODIFIED else LimitKind.NONE
        kind, _, j = row[:3]
        if kind in (OBSTACLE, SELF):
            return LimitKind.CONTACT
        if kind == USER:
            return LimitKind.CONSTRAINT
        is_position = kind in (LOWER, UPPER) and LIMIT_NAMES[j] == "position"
        return LimitKind.JOINT_POSITION if is_position else LimitKind.SPEED

    def _limiting(self) -> RawRow | None:
        """The binding row with the largest effect."""
        pairs = [row for row in self.binding_rows if row[0] not in (LOWER, UPPER)]
        joints = [row for row in self.binding_rows if row[0] in (LOWER, UPPER)]
        if pairs and (not joints or self.delta_rows >= self.delta_box):
            return max(pairs, key=lambda row: row[4])
        return max(joints, key=lambda row: (row[2], row[4]), default=None)  # position limits come first

    def unfiltered(self) -> FilterResult:
        """This result as it would be without filtering: u is u_nom, without a certificate."""
        return msgspec.structs.replace(
            self,
            u=self.u_nom,
            status=FilterStatus.SAFE,
            delta=0.0,
            delta_rows=0.0,
            delta_box=0.0,
            certified=False,
            packed_rows=b"",
            packed_evidence=(),
        )

    def explain(self, *, remedy: bool = True) -> str:
        """One sentence for people: the closest pair, and how the filter changed the control.

        For STOPPED and FAULT it states the cause; with `remedy` also its numbers, and what to do.
        """
        fast = f"; {REASON_TEXTS['OVERSPEED']}" if self.flags & Reason.OVERSPEED else ""
        if self.status is FilterStatus.SAFE:
            return f"passed unchanged; nearest pair at {self.h_min * 1e3:.0f} mm{fast}"
        if self.status is FilterStatus.MODIFIED:
            return f"{self._describe_rows()}: {self._describe_change()}{fast}"
        why = (
            "; ".join(REASON_TEXTS[flag.name] for flag in self.reason & ~Reason.RETREAT if flag.name in REASON_TEXTS)
            or "a limit of the box"
        )
        pairs = f": {self._describe_rows()}" if self.binding_rows else ""
        relaxed = (
            f"; given up in part: {', '.join(rank.name.lower() for rank in self.relaxed_ranks)}"
            if self.relaxed_ranks
            else ""
        )
        retreat = f"; {REASON_TEXTS['RETREAT']}" if self.flags & Reason.RETREAT else ""
        verb = "retreating" if retreat else "braking"
        sentence = f"{self.status.name.lower()}, {verb}: {why}{pairs}{relaxed}{retreat}"
        return f"{sentence}; {self._describe_stop()}" if remedy and self.status >= FilterStatus.STOPPED else sentence

    def _describe_stop(self) -> str:
        """The numbers of the cause, and the remedy."""
        numbers = [describe_evidence(evidence, self.names) for evidence in self.evidence]
        return "; ".join((*filter(None, numbers), stop_remedy(self.flags)))

    def _describe_rows(self) -> str:
        """The two rows with the largest multipliers by name, each name once, with its smallest distance."""
        nearest: dict[str, float] = {}
        for kind, i, j, h, _ in sorted(self.binding_rows, key=lambda row: -row[4]):
            name = self.names.row_name(kind, i, j)
            gap = h if kind in (OBSTACLE, SELF) else inf
            nearest[name] = min(nearest.get(name, inf), gap)
        words = [name + (f" {h * 1e3:.0f} mm" if h < inf else "") for name, h in list(nearest.items())[:2]]
        return " and ".join(words) or f"nearest pair {self.h_min * 1e3:.0f} mm"

    def _describe_change(self) -> str:
        wanted, got = self._relative_speed(self.u_nom), self._relative_speed(self.u)
        if got < 0.98 * wanted:
            return f"slowed {100.0 * (1.0 - got / wanted):.0f} %"
        if self.delta < 1e-3:
            return "changed by less than 0.1 % of full speed"
        return f"redirected by {100.0 * self.delta:.1f} % of full speed"

    def _relative_speed(self, u: Array) -> float:
        return sqrt(float(np.mean((u / np.array(self.names.v_max)) ** 2)))
