"""Filters on memories: conditions, and integer-coded columns beside the vectors on which they are evaluated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualbrain.memory.ledger.events import Status
from dualbrain.memory.state.episode_record import Guidance
from dualbrain.memory.state.state import MemoryState
from dualbrain.records import OutcomeClass

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Filter:
    """Conditions on a memory; an empty tuple or None sets no condition.

    `skills`: the contract of the memory contains all of them; `contract`: digest of the contract. `after` and `before`
    [s, 1970 UTC] bound the time at which the memory was stored. `writers` are the robots that wrote it into a shared
    ledger. By default only active memories pass: neither
    candidates nor quarantined or forgotten memories.
    """

    robot: str | None = None
    registry: str | None = None
    guidance: Guidance | None = None
    skills: tuple[str, ...] = ()
    contract: str | None = None
    outcomes: tuple[OutcomeClass, ...] = ()
    sources: tuple[str, ...] = ()
    statuses: tuple[Status, ...] = ("active",)
    after: float | None = None
    before: float | None = None
    writers: tuple[str, ...] = ()


MAX_CACHED_MASKS = 16
"""Number of filters whose masks are cached."""
STATIC_COLUMNS = ("scope", "guidance", "skills", "contract", "kind", "source", "writer")
"""Properties of a memory that never change; `scope` is the pair of robot and registry hash."""


class _Column:
    """Values of one property, each stored as an integer code."""

    def __init__(self) -> None:
        self.codes = np.empty(64, np.int32)
        self.code_by_value: dict[Any, int] = {}

    def set(self, row: int, value: Any) -> None:
        if row >= len(self.codes):
            growth = max(64, row // 2)
            self.codes = np.concatenate([self.codes[:row], np.empty(growth, np.int32)])
        self.codes[row] = self.code_by_value.setdefault(value, len(self.code_by_value))

    def isin(self, values: set[Any], n: int) -> Mask:
        """Mask of the first `n` rows whose value is in `values`, shape (n,)."""
        chosen = np.zeros(len(self.code_by_value), bool)
        chosen[[self.code_by_value[value] for value in values if value in self.code_by_value]] = True
        return chosen[self.codes[:n]]


class Columns:
    """The properties that filters read: one column per property, one row per memory."""

    def __init__(self) -> None:
        """Create columns without rows."""
        self._columns = {name: _Column() for name in (*STATIC_COLUMNS, "status")}
        self._times = np.empty(64)
        self._count = 0
        self._masks: dict[Filter, Mask] = {}

    def add(self, memo: MemoryState) -> None:
        """Append a row for `memo`."""
        row, self._count = self._count, self._count + 1
        self._masks.clear()
        if row == len(self._times):
            self._times = np.concatenate([self._times, np.empty(max(64, row // 2))])
        self._times[row] = memo.time
        provenance = memo.provenance
        scope = (memo.robot, memo.registry)
        values = (
            scope,
            memo.guidance,
            provenance.skills,
            provenance.contract,
            memo.kind,
            provenance.source,
            memo.writer,
        )
        for name, value in zip(STATIC_COLUMNS, values, strict=True):
            self._columns[name].set(row, value)
        self.set_status(row, memo.status)

    def set_status(self, row: int, status: Status) -> None:
        """Change the status of a row."""
        self._masks.clear()
        self._columns["status"].set(row, status)

    @property
    def contract_codes(self) -> NDArray[np.int32]:
        """Contract code of each row, shape (n,), equal for equal contracts; read-only."""
        return self._columns["contract"].codes[: self._count]

    def mask(self, where: Filter) -> Mask:
        """Mask of the rows that pass, shape (n,); read-only, cached until a row is added or a status changes."""
        if where not in self._masks:
            if len(self._masks) == MAX_CACHED_MASKS:
                self._masks.clear()
            self._masks[where] = self._compute_mask(where)
        return self._masks[where]

    def _compute_mask(self, where: Filter) -> Mask:
        n, columns = self._count, self._columns
        if not n:
            return np.zeros(0, bool)
        passed = columns["status"].isin(set(where.statuses), n)
        if where.robot is not None or where.registry is not None:
            scopes = {
                (robot, registry)
                for robot, registry in columns["scope"].code_by_value
                if where.robot in (None, robot) and where.registry in (None, registry)
            }
            passed &= columns["scope"].isin(scopes, n)
        if where.guidance is not None:
            passed &= columns["guidance"].isin({where.guidance}, n)
        if where.skills:
            chosen = {skills for skills in columns["skills"].code_by_value if set(where.skills) <= set(skills)}
            passed &= columns["skills"].isin(chosen, n)
        if where.contract is not None:
            passed &= columns["contract"].isin({where.contract}, n)
        for name, chosen in (("kind", where.outcomes), ("source", where.sources), ("writer", where.writers)):
            if chosen:
                passed &= columns[name].isin(set(chosen), n)
        if where.after is not None:
            passed &= self._times[:n] >= where.after
        if where.before is not None:
            passed &= self._times[:n] <= where.before
        return passed
