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
from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.core.storage.jsonl_log import JsonlLog
from dualbrain.errors import DECODE_ERRORS, ConfigurationError
from dualbrain.evaluation.protocol.method import METHODS
from dualbrain.evaluation.protocol.suite import Suite
from dualbrain.evaluation.report.adaptation_cost import AdapterCost
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.evaluation.runner.provenance import host_info
from dualbrain.evaluation.runner.work_units import Stage, WorkUnit, build_units
from dualbrain.evaluation.runner.worker_pool import WorkerPool

CONFIG_FILE, EPSILON_FILE, ERROR_LOG = "config.json", "epsilon.json", "errors"
HOST_KEY = "host"
"""Part of the configuration that only tells where the last start was; it may be another."""
EXTENDABLE_PARTS = ("methods", "planners", "adapters")
"""Parts of the configuration to which something may be added while what is there stays as it is."""
MAX_VALUE_CHARACTERS = 60
"""Characters of a value in a message."""
STAGES: tuple[Stage, ...] = ("pilot", "start", "plan", "fly")


@dataclass(frozen=True, slots=True, kw_only=True)
class StageProgress:
    """One line for a person: `done` of `total` episodes of a pass, `seconds_left` by the mean so far."""

    stage: Stage
    done: int
    total: int
    seconds_left: float | None
    line: dict[str, Any]
    error: str = ""


StageProgressCallback = Callable[[StageProgress], None]
OmissionCallback = Callable[[str], None]
"""Is told what could not be read and was left out."""


class PlanLine(msgspec.Struct, frozen=True):
    """A line of the plan pass: whether the question was really asked, and how long it took [s]."""

    key: str
    asked: int
    planner_s: float


class Runner:
    """Runs a suite into the folder `out`."""

    def __init__(
        self, suite: Suite, out: Path, *, clock: Callable[[], float], on_progress: StageProgressCallback
    ) -> None:
        """`clock` [s] measures the time left."""
        self.suite, self.out, self._clock, self._on_progress = suite, out, clock, on_progress

    def check_config(
        self, provenance: dict[str, Any], adapters: dict[str, AdapterCost] | None = None
    ) -> dict[str, Any]:
        """The resolved config; raises `InvalidSetup` if the folder holds another suite, other switches or other code.

        Methods and the planners that they ask may be added to what is there: their episodes are others. `adapters` says
        what those took that the suite asks.
        """
        config, path = resolve_config(self.suite, provenance, adapters or {}), self.out / CONFIG_FILE
        if path.exists():
            _require_same_config(read_config(path), config, path)
        return config

    def write_config(self, provenance: dict[str, Any], adapters: dict[str, AdapterCost] | None = None) -> None:
        """Write the resolved config, and on what machine, if the folder may be gone on with (see `check`)."""
        config = self.check_config(provenance, adapters) | {HOST_KEY: host_info()}
        self.out.mkdir(parents=True, exist_ok=True)
        write_atomically(self.out / CONFIG_FILE, msgspec.json.format(msgspec.json.encode(config), indent=2))

    def remaining_units(self, stage: Stage) -> list[WorkUnit]:
        """Units of a pass that are not over, each with what is done of it."""
        done = {line["key"] for line in self.read_lines(stage)}
        units: list[WorkUnit] = []
        for unit in build_units(self.suite, stage):
            whole = 0
            while whole < unit.n_episodes and unit.row_key(whole) in done:
                whole += 1
            if whole < unit.n_episodes:
                units.append(msgspec.structs.replace(unit, done=whole))
        return units

    def run_stage(self, stage: Stage, pool: WorkerPool) -> bool:
        """Carry out what is left of a pass; True if nothing is left then."""
        units = self.remaining_units(stage)
        total = sum(unit.n_episodes for unit in build_units(self.suite, stage))
        done, journal = total - sum(unit.n_episodes - unit.done for unit in units), self.log(stage)
        began, fresh = self._clock(), 0
        for report in pool.run_units(units):
            if report.error:
                trouble = {"key": report.unit.key, "error": report.error}
                self.log(ERROR_LOG).append(trouble)
                self._on_progress(
                    StageProgress(
                        stage=stage, done=done, total=total, seconds_left=None, line=trouble, error=report.error
                    )
                )
            if report.line is None:
                continue
            journal.append(report.line)
            done, fresh = done + 1, fresh + 1
            left = (self._clock() - began) / fresh * (total - done)
            self._on_progress(StageProgress(stage=stage, done=done, total=total, seconds_left=left, line=report.line))
        return not self.remaining_units(stage)

    def log(self, name: str) -> JsonlLog:
        """The journal of a pass."""
        return JsonlLog(self.out / f"{name}.jsonl")

    def read_lines(self, stage: Stage, on_omission: OmissionCallback | None = None) -> list[dict[str, Any]]:
        """The lines of a pass's journal, each with everything that belongs into it.

        One that lacks something is no trace of a kill: it raises `InvalidSetup`, or is told to `left_out`.
        """
        journal, kind, found = self.log(stage), PlanLine if stage == "plan" else EpisodeRow, list[dict[str, Any]]()
        for number, line in journal.read_numbered():
            try:
                msgspec.convert(line, kind)
            except msgspec.ValidationError as error:
                if on_omission is None:
                    again = "Delete it (where memory grows, all lines of its run): what it told is flown again."
                    raise ConfigurationError(
                        f"line {number} of {journal.path.name}",
                        got=str(error),
                        allowed="a line as it was written",
                        fix=f"{again} {journal.path}",
                    ) from error
                on_omission(f"Line {number} of {journal.path.name} ({error}).")
            else:
                found.append(line)
        return found

    def epsilon(self) -> dict[str, float]:
        """ε by robot: of the suite, or frozen once and for all from the pilot episodes."""
        wanted = self.suite.memory.epsilon
        robots = sorted({robot for task in self.suite.tasks for robot in self.suite.robots_of(task)})
        if isinstance(wanted, float):
            return dict.fromkeys(robots, wanted)
        path = self.out / EPSILON_FILE
        if path.exists():
            return _read_epsilon(path)
        found = pilot_epsilon(parse_rows(self.read_lines("pilot")), robots)
        write_atomically(path, msgspec.json.encode(found))
        return found

    def rows(self, on_omission: OmissionCallback | None = None) -> list[EpisodeRow]:
        """Every finished episode, in the order of the suite; `left_out` as for `lines`."""
        lines = {line["key"]: line for line in self.read_lines("fly", on_omission)}
        keys = [unit.row_key(order) for unit in build_units(self.suite, "fly") for order in range(unit.n_episodes)]
        return parse_rows(lines[key] for key in keys if key in lines)


def read_config(path: Path) -> dict[str, Any]:
    """The configuration at `path`; raises `InvalidSetup`."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=dict[str, Any])
    except DECODE_ERRORS as error:
        raise _damaged_config(path, error) from error


def suite_from_config(config: dict[str, Any], path: Path) -> Suite:
    """The suite in the configuration that was read from `path`; raises `InvalidSetup`."""
    try:
        return msgspec.convert(config.get("suite"), Suite)
    except msgspec.ValidationError as error:
        raise _damaged_config(path, error) from error


def _damaged_config(path: Path, error: Exception) -> ConfigurationError:
    fix = f"Bring back a copy, or name another --out. {path}"
    return ConfigurationError("configuration of the results", got=str(error), allowed="as it was written", fix=fix)


def _read_epsilon(path: Path) -> dict[str, float]:
    """ε by robot as it was frozen; raises `InvalidSetup`."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=dict[str, float])
    except DECODE_ERRORS as error:
        fix = f"Delete it: it is found again from the same pilot. {path}"
        raise ConfigurationError("frozen epsilon", got=str(error), allowed="a number by robot", fix=fix) from error


def parse_rows(lines: Iterable[dict[str, Any]]) -> list[EpisodeRow]:
    """Lines of a journal as rows."""
    return [msgspec.convert(line, EpisodeRow) for line in lines]


def pilot_epsilon(rows: list[EpisodeRow], robots: Iterable[str]) -> dict[str, float]:
    """By robot, the median Δ of those of the pilot's successes that the filter corrected, Δ above the dead band.

    Where it corrected none, the dead band; raises `InvalidSetup` where nothing succeeded. Untouched successes do not
    count: were most of them untouched, any correction would be a bad one, wherever it cannot be avoided.
    """
    found: dict[str, float] = {}
    for robot in robots:
        sizes = [row.Delta for row in rows if row.robot == robot and row.success and row.Delta is not None]
        if not sizes:
            fix = "Fly more pilot episodes, or state epsilon."
            raise ConfigurationError(f"pilot of {robot}", got="no success", allowed="at least one", fix=fix)
        found[robot] = median([size for size in sizes if size > DEAD_BAND] or [DEAD_BAND])
    return found


def resolve_config(suite: Suite, provenance: dict[str, Any], adapters: dict[str, AdapterCost]) -> dict[str, Any]:
    """The whole configuration: suite, every switch of its methods, and where the code comes from."""
    arms = {name: METHODS[name] for name in suite.methods}
    return msgspec.json.decode(
        msgspec.json.encode({"suite": suite, "methods": arms, "origin": provenance, "adapters": adapters})
    )


def _require_same_config(before: dict[str, Any], now: dict[str, Any], path: Path) -> None:
    """Raise `InvalidSetup` unless `now` is what was `before`, perhaps with more methods and planners for them."""
    differing = sorted(part for part in now if not _is_extension(before.get(part), now[part], part))
    if differing:
        got = "; ".join(_describe_difference(part, before.get(part), now[part]) for part in differing)
        fix = f"Name another --out, or go back to the code and versions that began it. {path}"
        allowed = "the same suite and code, and all its methods, perhaps with others"
        raise ConfigurationError("evaluation that lies here", got=got, allowed=allowed, fix=fix)


def _describe_difference(part: str, before: Any, now: Any) -> str:
    """In what a part of the configuration differs, entry by entry where it has entries."""
    if not (isinstance(before, dict) and isinstance(now, dict)):
        return f"{part} is another"
    inner = before if part in EXTENDABLE_PARTS else before | now
    names = sorted(name for name in inner if name not in now or not _is_extension(before.get(name), now[name], name))
    told = (f"{part}.{name} is {_truncate(now.get(name))}, was {_truncate(before.get(name))}" for name in names)
    return "; ".join(told)


def _truncate(value: Any) -> str:
    text = "nothing" if value is None else str(value)
    return text if len(text) <= MAX_VALUE_CHARACTERS else f"{text[:MAX_VALUE_CHARACTERS]}…"


def _is_extension(before: Any, now: Any, name: str = "") -> bool:
    """Whether `now` is `before`; methods, planners and adapters may have become more."""
    if isinstance(before, dict) and isinstance(now, dict):
        names = before if name in EXTENDABLE_PARTS else before | now
        return all(one in before and one in now and _is_extension(before[one], now[one], one) for one in names)
    if isinstance(before, list) and name in EXTENDABLE_PARTS:
        return set(before) <= set(now)
    return before == now
