"""The whole evaluation: ε, the common ledger, the planner's answers, the episodes; each pass resumable.

What is on disk decides what is left: a pass is over when its journal holds every row. The journals are the truth; the
Parquet file is written from them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import msgspec

from dualbrain.control.recording.trace import DEAD_BAND
from dualbrain.core.storage.atomic_files import write_durably
from dualbrain.core.storage.jsonl_log import Journal
from dualbrain.errors import UNREADABLE, InvalidSetup
from dualbrain.evaluation.protocol.method import METHODS
from dualbrain.evaluation.protocol.suite import Suite
from dualbrain.evaluation.report.adaptation_cost import Cost
from dualbrain.evaluation.results.episode_row import Row
from dualbrain.evaluation.runner.provenance import host
from dualbrain.evaluation.runner.work_units import Stage, Unit, units_of
from dualbrain.evaluation.runner.worker_pool import Crew

CONFIG, EPSILON, ERRORS = "config.json", "epsilon.json", "errors"
HOST = "host"
"""Part of the configuration that only tells where the last start was; it may be another."""
GROWING = ("methods", "planners", "adapters")
"""Parts of the configuration to which something may be added while what is there stays as it is."""
MOST_TOLD = 60
"""Characters of a value in a message."""
STAGES: tuple[Stage, ...] = ("pilot", "start", "plan", "fly")


@dataclass(frozen=True, slots=True)
class Progress:
    """One line for a person: `done` of `total` episodes of a pass, `seconds_left` by the mean so far."""

    stage: Stage
    done: int
    total: int
    seconds_left: float | None
    line: dict[str, Any]
    error: str = ""


Tell = Callable[[Progress], None]
LeftOut = Callable[[str], None]
"""Is told what could not be read and was left out."""


class Asked(msgspec.Struct, frozen=True):
    """A line of the plan pass: whether the question was really asked, and how long it took [s]."""

    key: str
    asked: int
    planner_s: float


class Runner:
    """Runs a suite into the folder `out`."""

    def __init__(self, suite: Suite, out: Path, *, clock: Callable[[], float], tell: Tell) -> None:
        """`clock` [s] measures the time left."""
        self.suite, self.out, self._clock, self._tell = suite, out, clock, tell

    def check(self, origin: dict[str, Any], adapters: dict[str, Cost] | None = None) -> dict[str, Any]:
        """The resolved config; raises `InvalidSetup` if the folder holds another suite, other switches or other code.

        Methods and the planners that they ask may be added to what is there: their episodes are others. `adapters` says
        what those took that the suite asks.
        """
        config, path = resolved(self.suite, origin, adapters or {}), self.out / CONFIG
        if path.exists():
            _same(read_config(path), config, path)
        return config

    def prepare(self, origin: dict[str, Any], adapters: dict[str, Cost] | None = None) -> None:
        """Write the resolved config, and on what machine, if the folder may be gone on with (see `check`)."""
        config = self.check(origin, adapters) | {HOST: host()}
        self.out.mkdir(parents=True, exist_ok=True)
        write_durably(self.out / CONFIG, msgspec.json.format(msgspec.json.encode(config), indent=2))

    def left(self, stage: Stage) -> list[Unit]:
        """Units of a pass that are not over, each with what is done of it."""
        done = {line["key"] for line in self.lines(stage)}
        units: list[Unit] = []
        for unit in units_of(self.suite, stage):
            whole = 0
            while whole < unit.count and unit.row_key(whole) in done:
                whole += 1
            if whole < unit.count:
                units.append(msgspec.structs.replace(unit, done=whole))
        return units

    def advance(self, stage: Stage, crew: Crew) -> bool:
        """Carry out what is left of a pass; True if nothing is left then."""
        units = self.left(stage)
        total = sum(unit.count for unit in units_of(self.suite, stage))
        done, journal = total - sum(unit.count - unit.done for unit in units), self.journal(stage)
        began, fresh = self._clock(), 0
        for report in crew.carry_out(units):
            if report.error:
                trouble = {"key": report.unit.key, "error": report.error}
                self.journal(ERRORS).append(trouble)
                self._tell(Progress(stage, done, total, None, trouble, report.error))
            if report.line is None:
                continue
            journal.append(report.line)
            done, fresh = done + 1, fresh + 1
            left = (self._clock() - began) / fresh * (total - done)
            self._tell(Progress(stage, done, total, left, report.line))
        return not self.left(stage)

    def journal(self, name: str) -> Journal:
        """The journal of a pass."""
        return Journal(self.out / f"{name}.jsonl")

    def lines(self, stage: Stage, left_out: LeftOut | None = None) -> list[dict[str, Any]]:
        """The lines of a pass's journal, each with everything that belongs into it.

        One that lacks something is no trace of a kill: it raises `InvalidSetup`, or is told to `left_out`.
        """
        journal, kind, found = self.journal(stage), Asked if stage == "plan" else Row, list[dict[str, Any]]()
        for number, line in journal.numbered():
            try:
                msgspec.convert(line, kind)
            except msgspec.ValidationError as error:
                if left_out is None:
                    again = "Delete it (where memory grows, all lines of its run): what it told is flown again."
                    raise InvalidSetup(
                        f"line {number} of {journal.path.name}", got=str(error), allowed="a line as it was written",
                        fix=f"{again} {journal.path}",
                    ) from error  # fmt: skip
                left_out(f"Line {number} of {journal.path.name} ({error}).")
            else:
                found.append(line)
        return found

    def epsilon(self) -> dict[str, float]:
        """ε by robot: of the suite, or frozen once and for all from the pilot episodes."""
        wanted = self.suite.memory.epsilon
        robots = sorted({robot for task in self.suite.tasks for robot in self.suite.robots_of(task)})
        if isinstance(wanted, float):
            return dict.fromkeys(robots, wanted)
        path = self.out / EPSILON
        if path.exists():
            return _frozen_epsilon(path)
        found = pilot_epsilon(rows_of(self.lines("pilot")), robots)
        write_durably(path, msgspec.json.encode(found))
        return found

    def rows(self, left_out: LeftOut | None = None) -> list[Row]:
        """Every finished episode, in the order of the suite; `left_out` as for `lines`."""
        lines = {line["key"]: line for line in self.lines("fly", left_out)}
        keys = [unit.row_key(order) for unit in units_of(self.suite, "fly") for order in range(unit.count)]
        return rows_of(lines[key] for key in keys if key in lines)


def read_config(path: Path) -> dict[str, Any]:
    """The configuration at `path`; raises `InvalidSetup`."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=dict[str, Any])
    except UNREADABLE as error:
        raise _damaged(path, error) from error


def suite_of(config: dict[str, Any], path: Path) -> Suite:
    """The suite in the configuration that was read from `path`; raises `InvalidSetup`."""
    try:
        return msgspec.convert(config.get("suite"), Suite)
    except msgspec.ValidationError as error:
        raise _damaged(path, error) from error


def _damaged(path: Path, error: Exception) -> InvalidSetup:
    fix = f"Bring back a copy, or name another --out. {path}"
    return InvalidSetup("configuration of the results", got=str(error), allowed="as it was written", fix=fix)


def _frozen_epsilon(path: Path) -> dict[str, float]:
    """ε by robot as it was frozen; raises `InvalidSetup`."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=dict[str, float])
    except UNREADABLE as error:
        fix = f"Delete it: it is found again from the same pilot. {path}"
        raise InvalidSetup("frozen epsilon", got=str(error), allowed="a number by robot", fix=fix) from error


def rows_of(lines: Iterable[dict[str, Any]]) -> list[Row]:
    """Lines of a journal as rows."""
    return [msgspec.convert(line, Row) for line in lines]


def pilot_epsilon(rows: list[Row], robots: Iterable[str]) -> dict[str, float]:
    """By robot, the median Δ of those of the pilot's successes that the filter corrected, Δ above the dead band.

    Where it corrected none, the dead band; raises `InvalidSetup` where nothing succeeded. Untouched successes do not
    count: were most of them untouched, any correction would be a bad one, wherever it cannot be avoided.
    """
    found: dict[str, float] = {}
    for robot in robots:
        sizes = [row.Delta for row in rows if row.robot == robot and row.success and row.Delta is not None]
        if not sizes:
            fix = "Fly more pilot episodes, or state epsilon."
            raise InvalidSetup(f"pilot of {robot}", got="no success", allowed="at least one", fix=fix)
        found[robot] = median([size for size in sizes if size > DEAD_BAND] or [DEAD_BAND])
    return found


def resolved(suite: Suite, origin: dict[str, Any], adapters: dict[str, Cost]) -> dict[str, Any]:
    """The whole configuration: suite, every switch of its methods, and where the code comes from."""
    arms = {name: METHODS[name] for name in suite.methods}
    return msgspec.json.decode(
        msgspec.json.encode({"suite": suite, "methods": arms, "origin": origin, "adapters": adapters})
    )


def _same(before: dict[str, Any], now: dict[str, Any], path: Path) -> None:
    """Raise `InvalidSetup` unless `now` is what was `before`, perhaps with more methods and planners for them."""
    differing = sorted(part for part in now if not _grown(before.get(part), now[part], part))
    if differing:
        got = "; ".join(_otherwise(part, before.get(part), now[part]) for part in differing)
        fix = f"Name another --out, or go back to the code and versions that began it. {path}"
        allowed = "the same suite and code, and all its methods, perhaps with others"
        raise InvalidSetup("evaluation that lies here", got=got, allowed=allowed, fix=fix)


def _otherwise(part: str, before: Any, now: Any) -> str:
    """In what a part of the configuration differs, entry by entry where it has entries."""
    if not (isinstance(before, dict) and isinstance(now, dict)):
        return f"{part} is another"
    inner = before if part in GROWING else before | now
    names = sorted(name for name in inner if name not in now or not _grown(before.get(name), now[name], name))
    told = (f"{part}.{name} is {_short(now.get(name))}, was {_short(before.get(name))}" for name in names)
    return "; ".join(told)


def _short(value: Any) -> str:
    text = "nothing" if value is None else str(value)
    return text if len(text) <= MOST_TOLD else f"{text[:MOST_TOLD]}…"


def _grown(before: Any, now: Any, name: str = "") -> bool:
    """Whether `now` is `before`; methods, planners and adapters may have become more."""
    if isinstance(before, dict) and isinstance(now, dict):
        names = before if name in GROWING else before | now
        return all(one in before and one in now and _grown(before[one], now[one], one) for one in names)
    if isinstance(before, list) and name in GROWING:
        return set(before) <= set(now)
    return before == now
