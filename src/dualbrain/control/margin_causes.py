"""Intervals in which h is below 0, each with its cause.

In the first tick of such an interval the monitor compares the tables of the filter, the fingers and the last result
with those of the tick before. The cause is the change that explains the fall of h of the nearest pair. Everything that
it reads is in the recording, so a replay finds the same causes.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np

from dualbrain.core.geometry.distance import signed_distance
from dualbrain.records import MarginCause, MarginShortfall
from dualbrain.robots.interface import RobotState
from dualbrain.safety.cbf.filter import FilterTables, SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.cbf.result import OBSTACLE, FilterResult, FilterStatus
from dualbrain.safety.cbf.rows import BarrierRow

ACCELERATION_MEMORY = 0.1
"""Time [s] after a change of an obstacle's velocity during which an infeasible step counts as its consequence."""
OPENING_TOLERANCE = 1e-5
"""Change of the finger opening in one tick [m] from which the fingers move."""
HELD = "held"


@dataclass(frozen=True, slots=True)
class _Tick:
    """What the next tick is compared with."""

    tables: FilterTables
    result: FilterResult
    opening: float | None


class MarginMonitor:
    """Finds the intervals with h < 0 of one filter and their causes; call `update` after every step of the filter."""

    def __init__(self, safety: SafetyFilter) -> None:
        """Start before the first step of `safety`."""
        self._safety = safety
        self._lag = 0.0 if safety.robot_model.is_mobile else safety.robot_model.tracking.lag
        self._before: _Tick | None = None
        self._accelerated: dict[str, float] = {}
        self._closed: list[MarginShortfall] = []
        self._open: MarginShortfall | None = None

    @property
    def shortfalls(self) -> tuple[MarginShortfall, ...]:
        """All intervals since `clear`, the last one possibly still open."""
        return (*self._closed, self._open) if self._open else tuple(self._closed)

    def clear(self) -> None:
        """Forget the intervals that have ended."""
        self._closed.clear()

    def add(self, shortfall: MarginShortfall) -> None:
        """Add an interval that the filter does not see: the margin of an obstacle that is being introduced."""
        self._closed.append(shortfall)

    def between(self, first: float, last: float) -> tuple[MarginShortfall, ...]:
        """The intervals that overlap the time from `first` to `last` [s]."""
        return tuple(one for one in self.shortfalls if one.start <= last and one.start + one.duration >= first)

    def update(self, now: float, state: RobotState, result: FilterResult) -> MarginShortfall | None:
        """Take the `result` of a step at `now` [s] from `state`; returns an interval that begins with this step."""
        tables, before = self._safety.tables, self._before
        if before is None or tables.obstacles is not before.tables.obstacles:
            self._note_accelerations(before.tables if before else None, tables, now)
        begun = None
        if not result.h_min < 0.0:
            if self._open is not None:
                self._closed.append(self._open)
                self._open = None
        elif self._open is None:
            begun = self._open = self._begin(now, state, result)
        else:
            least = min(self._open.h_min, result.h_min)
            duration = now - self._open.start + self._safety.robot_model.period
            self._open = msgspec.structs.replace(self._open, h_min=least, duration=duration)
        self._before = _Tick(tables, result, state.opening)
        return begun

    def _note_accelerations(self, before: FilterTables | None, tables: FilterTables, now: float) -> None:
        """Note the obstacles whose velocity changed by more than the errors of both observations."""
        former = {one.name: one for one in before.obstacles} if before else {}
        for one in tables.obstacles:
            if one.moves and (last := former.get(one.name)) is not None and _velocity_changed(last, one):
                self._accelerated[one.name] = now

    def _begin(self, now: float, state: RobotState, result: FilterResult) -> MarginShortfall:
        rows = [row for row in self._safety.rows() if not self._safety.is_permitted(row.kind, row.i, row.j)]
        row = min((row for row in rows if row.h < 0.0), key=lambda row: row.h, default=None)
        cause, change = self._find_cause(now, state, result, row)
        return MarginShortfall(
            start=now,
            duration=self._safety.robot_model.period,
            h_min=result.h_min,
            pair=row.name if row else "",
            cause=cause,
            change=change,
        )

    def _find_cause(
        self, now: float, state: RobotState, result: FilterResult, row: BarrierRow | None
    ) -> tuple[MarginCause, float]:
        """The cause of h < 0 of the pair of `row`, and the fall of h that it caused [m]."""
        before, tables = self._before, self._safety.tables
        if before is None:
            return MarginCause.START, -result.h_min
        fall = max(0.0, before.result.h_min) - result.h_min
        held = row is None or row.name.partition(" vs ")[0] == HELD or HELD in row.name.partition(" vs ")[2]
        obstacle = tables.obstacles[row.j] if row is not None and row.kind == OBSTACLE else None
        if tables.grasp_changes != before.tables.grasp_changes and (held or _appeared(obstacle, before.tables)):
            return MarginCause.ATTACH_DETACH, fall
        if row and obstacle and (found := self._table_cause(now, state, row, obstacle)):
            return found
        return self._motion_cause(now, state, row, obstacle), fall

    def _table_cause(
        self, now: float, state: RobotState, row: BarrierRow, obstacle: Obstacle
    ) -> tuple[MarginCause, float] | None:
        """The change of permits or obstacles that explains h < 0 of the pair, None if none does."""
        assert self._before is not None
        before, tables = self._before.tables, self._safety.tables
        if self._was_permitted(before, row, obstacle):
            return MarginCause.PERMIT_END, -row.h
        if tables.obstacles is before.obstacles:
            return None
        former = next((one for one in before.obstacles if one.name == obstacle.name), None)
        if former is None:
            return MarginCause.PERCEPTION_JUMP, -row.h
        y = np.asarray(state.q) + self._lag * np.asarray(state.v) if self._lag else state.q
        centre = self._safety.spheres(y, state.opening)[0][row.i]
        change = _clearance(former, centre, now - before.stamp) - _clearance(obstacle, centre, now - tables.stamp)
        if row.h + change < 0.0:
            return None
        if obstacle.moves and _velocity_changed(former, obstacle):
            return MarginCause.PERSON_ACCELERATION, change
        return MarginCause.PERCEPTION_JUMP, change

    def _was_permitted(self, before: FilterTables, row: BarrierRow, obstacle: Obstacle) -> bool:
        """Whether the tick before permitted contact of the part of `row` with `obstacle`."""
        part = row.name.partition(" vs ")[0]
        groups = {link.name: link.group for link in self._safety.robot_model.links}
        parts = {part, groups.get(part, part)}
        return any(one.obstacle == obstacle.name and one.robot_part in parts for one in before.permits)

    def _motion_cause(
        self, now: float, state: RobotState, row: BarrierRow | None, obstacle: Obstacle | None
    ) -> MarginCause:
        """The cause of h < 0 of a pair that no table changed: the control before, the fingers, or the drive."""
        assert self._before is not None
        result, opening = self._before.result, self._before.opening
        if result.delta_supervisor > 0.0:
            return MarginCause.SUPERVISOR
        if result.status > FilterStatus.MODIFIED or not result.certified:
            recent = obstacle is not None and now - self._accelerated.get(obstacle.name, -np.inf) <= ACCELERATION_MEMORY
            return MarginCause.PERSON_ACCELERATION if recent else MarginCause.INFEASIBILITY
        if self._moves_with_fingers(row) and _opening_changed(opening, state.opening):
            return MarginCause.GRIPPER
        return MarginCause.TRACKING

    def _moves_with_fingers(self, row: BarrierRow | None) -> bool:
        """Whether a side of the pair moves with the opening of the fingers."""
        fingers = {link.name for link in self._safety.robot_model.links if any(link.slide)}
        return row is not None and not fingers.isdisjoint(row.name.split(" vs "))


def _appeared(obstacle: Obstacle | None, before: FilterTables) -> bool:
    """Whether `obstacle` was not in the table before."""
    return obstacle is not None and all(one.name != obstacle.name for one in before.obstacles)


def _velocity_changed(before: Obstacle, now: Obstacle) -> bool:
    """Whether the velocity changed by more than the errors of both observations."""
    change = float(np.linalg.norm(np.subtract(now.velocity, before.velocity)))
    return change > before.velocity_error + now.velocity_error


def _opening_changed(before: float | None, now: float | None) -> bool:
    """Whether the fingers moved between two ticks, or became unknown."""
    if before is None or now is None:
        return before is not now
    return abs(now - before) > OPENING_TOLERANCE


def _clearance(obstacle: Obstacle, point: np.ndarray, age: float) -> float:
    """Distance [m] of `point` (3,) from `obstacle` at the `age` [s] of its observation, minus its margin."""
    here = point - age * np.asarray(obstacle.velocity)
    margin = obstacle.margin + obstacle.velocity_error * max(0.0, age)
    return float(signed_distance(obstacle.shape, obstacle.pose, here[None, :])[0]) - margin
