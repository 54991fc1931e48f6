"""Runs an evaluation in resumable stages: pilot episodes for ε, common start ledger, planner answers, episodes.

The logs on disk decide which work is left: a stage is complete when its log holds every row. The Parquet file is
written from the logs.
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
from dualbrain.core.storage.private_files import open_private_folder
from dualbrain.core.untrusted.bounded_file import read_bounded_file
from dualbrain.errors import DECODE_ERRORS, ConfigurationError
from dualbrain.evaluation.protocol.method import METHODS
from dualbrain.evaluation.protocol.suite import Suite, check_robots
from dualbrain.evaluation.report.adaptation_cost import AdapterCost
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.evaluation.runner.parts.part import Part
from dualbrain.evaluation.runner.provenance import host_info
from dualbrain.evaluation.runner.work_units import Stage, WorkUnit, build_units
from dualbrain.evaluation.runner.worker_pool import WorkerPool

MAX_CONFIG_BYTES = 64 << 20
"""Largest size of the configuration of an evaluation."""

CONFIG_FILE, EPSILON_FILE, ERROR_LOG = "config.json", "epsilon.json", "errors"
HOST_KEY = "host"
"""Part of the configuration that describes the machine of the last start; it may change."""
PART_KEY = "part"
"""Entry of the configuration that names the part of the evaluation; not in results of a whole evaluation."""
EXTENDABLE_PARTS = ("methods", "planners", "adapters")
"""Parts of the configuration to which entries may be added while the existing entries stay as they are."""
MAX_VALUE_CHARACTERS = 60
"""Maximum number of characters of a value in a message."""
STAGES: tuple[Stage, ...] = ("pilot", "start", "plan", "fly")


@dataclass(frozen=True, slots=True, kw_only=True)
class StageProgress:
    """Progress of a stage: `done` of `total` episodes, `seconds_left` [s] estimated from the mean so far.

    `line` is the last log line; `error` is set if a unit failed.
    """

    stage: Stage
    done: int
    total: int
    seconds_left: float | None
    line: dict[str, Any]
    error: str = ""


StageProgressCallback = Callable[[StageProgress], None]
OmissionCallback = Callable[[str], None]
"""Receives a sentence about each log line that cannot be read and is left out."""


class PlanLine(msgspec.Struct, frozen=True):
    """A log line of the plan stage: 1 if the planner computed the answer (0: cached), and the time that it took [s]."""

    key: str
    asked: int
    planner_s: float


class Runner:
    """Runs a suite into the folder `out`."""

    def __init__(
        self,
        suite: Suite,
        out: Path,
        *,
        clock: Callable[[], float],
        on_progress: StageProgressCallback,
        part: Part | None = None,
    ) -> None:
        """`clock` [s] serves to estimate the remaining time; `on_progress` receives each progress report.

        With a `part`, only its units are run.
        """
        self.suite, self.out, self.part, self._clock, self._on_progress = suite, out, part, clock, on_progress

    def select_part(self, part: Part) -> Runner:
        """A runner of `part` only, in the folder of this part inside the folder of this runner."""
        return Runner(self.suite, part.folder(self.out), clock=self._clock, on_progress=self._on_progress, part=part)

    def units(self, stage: Stage) -> list[WorkUnit]:
        """All units of a stage, or those of the part."""
        return self.part.units(self.suite, stage) if self.part else build_units(self.suite, stage)

    def check_config(
        self, provenance: dict[str, Any], adapters: dict[str, AdapterCost] | None = None
    ) -> dict[str, Any]:
        """The resolved configuration, with the training cost of the suite's `adapters`.

        Raises `ConfigurationError` if the folder holds results of another suite, with other settings or of other code.
        Methods and their planners may be added to existing results, because their episodes are separate.
        """
        config, path = resolve_config(self.suite, provenance, adapters or {}), self.out / CONFIG_FILE
        if self.part:
            config[PART_KEY] = str(self.part)
        if path.exists():
            before = read_config(path)
            _require_same_part(before, config, path)
            _require_same_config(before, config, path)
        return config

    def write_config(self, provenance: dict[str, Any], adapters: dict[str, AdapterCost] | None = None) -> None:
        """Write the resolved configuration and a description of this machine; raises as `check_config`."""
        config = self.check_config(provenance, adapters) | {HOST_KEY: host_info()}
        open_private_folder(self.out)
        write_atomically(self.out / CONFIG_FILE, msgspec.json.format(msgspec.json.encode(config), indent=2))

    def remaining_units(self, stage: Stage) -> list[WorkUnit]:
        """Unfinished units of a stage, each with the number of its finished episodes."""
        done = {line["key"] for line in self.read_lines(stage)}
        units: list[WorkUnit] = []
        for unit in self.units(stage):
            finished = 0
            while finished < unit.n_episodes and unit.row_key(finished) in done:
                finished += 1
            if finished < unit.n_episodes:
                units.append(msgspec.structs.replace(unit, done=finished))
        return units

    def run_stage(self, stage: Stage, pool: WorkerPool) -> bool:
        """Run the unfinished units of a stage; True if the stage is complete afterwards."""
        units = self.remaining_units(stage)
        total = sum(unit.n_episodes for unit in self.units(stage))
        done, log = total - sum(unit.n_episodes - unit.done for unit in units), self.log(stage)
        start, fresh = self._clock(), 0
        for report in pool.run_units(units):
            if report.error:
                failure = {"key": report.unit.key, "error": report.error, "traceback": report.traceback}
                self.log(ERROR_LOG).append(failure)
                self._on_progress(
                    StageProgress(
                        stage=stage, done=done, total=total, seconds_left=None, line=failure, error=report.error
                    )
                )
            if report.line is None:
                continue
            log.append(report.line)
            done, fresh = done + 1, fresh + 1
            left = (self._clock() - start) / fresh * (total - done)
            self._on_progress(StageProgress(stage=stage, done=done, total=total, seconds_left=left, line=report.line))
        return not self.remaining_units(stage)

    def log(self, name: str) -> JsonlLog:
        """The log of a stage, or the log of errors."""
        return JsonlLog(self.out / f"{name}.jsonl")

    def read_lines(self, stage: Stage, on_omission: OmissionCallback | None = None) -> list[dict[str, Any]]:
        """The lines of a stage's log that hold all fields of their kind.

        A complete line that lacks a field is damaged, not cut off by a kill: it is reported to `on_omission`, or raises
        `ConfigurationError` without one.
        """
        log, kind, found = self.log(stage), PlanLine if stage == "plan" else EpisodeRow, list[dict[str, Any]]()
        for number, line in log.read_numbered():
            try:
                msgspec.convert(line, kind)
            except msgspec.ValidationError as error:
                if on_omission is None:
                    sentence = f"Line {number} of {log.path.name} is damaged: {error}."
                    again = "Delete it (with memory, all lines of its run), and its episode is run again."
                    raise ConfigurationError.stating(sentence, fix=f"{again} {log.path}") from error
                on_omission(f"Line {number} of {log.path.name} ({error}).")
            else:
                found.append(line)
        return found

    def epsilon(self) -> dict[str, float]:
        """ε by robot: the suite's value, or the one that was determined once from the pilot episodes.

        Raises `ConfigurationError` if the stored values are damaged, or no pilot episode of a robot succeeded.
        """
        stated = self.suite.memory.epsilon
        robots = sorted({unit.robot for unit in self.units("fly")})
        if isinstance(stated, float):
            return dict.fromkeys(robots, stated)
        path = self.out / EPSILON_FILE
        if path.exists():
            return read_epsilon(path)
        found = pilot_epsilon(parse_rows(self.read_lines("pilot")), robots)
        write_atomically(path, msgspec.json.encode(found))
        return found

    def rows(self, on_omission: OmissionCallback | None = None) -> list[EpisodeRow]:
        """Every finished episode, in the order of the suite; `on_omission` as for `read_lines`."""
        lines = {line["key"]: line for line in self.read_lines("fly", on_omission)}
        keys = [unit.row_key(order) for unit in self.units("fly") for order in range(unit.n_episodes)]
        return parse_rows(lines[key] for key in keys if key in lines)


def read_config(path: Path) -> dict[str, Any]:
    """The configuration at `path`; raises `ConfigurationError` if it is damaged."""
    try:
        return msgspec.json.decode(read_bounded_file(path, MAX_CONFIG_BYTES), type=dict[str, Any])
    except DECODE_ERRORS as error:
        raise _damaged_config(path, error) from error


def suite_from_config(config: dict[str, Any], path: Path) -> Suite:
    """The suite in the configuration that was read from `path`; raises `ConfigurationError` if it is damaged.

    Results of other versions are read even if this version refuses their suite, except for an unknown robot
    (`UnknownNameError`), whose name could be that of a file.
    """
    try:
        suite = msgspec.convert(config.get("suite"), Suite)
    except msgspec.ValidationError as error:
        raise _damaged_config(path, error) from error
    check_robots(suite)
    return suite


def _damaged_config(path: Path, error: Exception) -> ConfigurationError:
    sentence = f"The configuration of the results is damaged: {error}."
    return ConfigurationError.stating(sentence, fix=f"Restore a copy, or name another --out. {path}")


def read_epsilon(path: Path) -> dict[str, float]:
    """The stored ε by robot; raises `ConfigurationError` if the file is damaged."""
    try:
        return msgspec.json.decode(read_bounded_file(path, MAX_CONFIG_BYTES), type=dict[str, float])
    except DECODE_ERRORS as error:
        sentence = f"The stored ε by robot is damaged: {error}."
        fix = f"Delete it: it is computed again from the same pilot episodes. {path}"
        raise ConfigurationError.stating(sentence, fix=fix) from error


def parse_rows(lines: Iterable[dict[str, Any]]) -> list[EpisodeRow]:
    """Lines of a log as rows."""
    return [msgspec.convert(line, EpisodeRow) for line in lines]


def pilot_epsilon(rows: list[EpisodeRow], robots: Iterable[str]) -> dict[str, float]:
    """By robot, the median Δ of the successful pilot episodes in which the filter intervened (Δ above the dead band).

    If it intervened in none, the dead band. Episodes without intervention do not count: if most episodes were among
    them, ε would be zero, and any intervention would count as bad, even an unavoidable one. Raises `ConfigurationError`
    if no pilot episode of a robot succeeded.
    """
    found: dict[str, float] = {}
    for robot in robots:
        sizes = [row.Delta for row in rows if row.robot == robot and row.success and row.Delta is not None]
        if not sizes:
            fix = "Run more pilot episodes, or state epsilon."
            raise ConfigurationError.stating(f"No pilot episode of {robot} succeeded.", fix=fix)
        found[robot] = median([size for size in sizes if size > DEAD_BAND] or [DEAD_BAND])
    return found


def resolve_config(suite: Suite, provenance: dict[str, Any], adapters: dict[str, AdapterCost]) -> dict[str, Any]:
    """The complete configuration: suite, all settings of its methods, provenance of the code, cost of the adapters.

    The newest setting of a method is stored only if it is set, so that configurations can be compared with older ones.
    """
    methods = {name: msgspec.to_builtins(METHODS[name]) for name in suite.methods}
    for settings in methods.values():
        if not settings["reuse_contracts"]:
            del settings["reuse_contracts"]
    return msgspec.json.decode(
        msgspec.json.encode({"suite": suite, "methods": methods, "origin": provenance, "adapters": adapters})
    )


def _require_same_part(before: dict[str, Any], now: dict[str, Any], path: Path) -> None:
    """Raise `ConfigurationError` unless both configurations are of the same part, or both of a whole evaluation."""
    was, is_now = (f"part {one[PART_KEY]}" if PART_KEY in one else "all parts" for one in (before, now))
    if was != is_now:
        raise ConfigurationError.stating(
            f"The folder holds results of {was} of the evaluation, not of {is_now}.", fix=f"Name another --out. {path}"
        )


def _require_same_config(before: dict[str, Any], now: dict[str, Any], path: Path) -> None:
    """Raise `ConfigurationError` unless `now` equals `before`, perhaps with more methods and planners for them."""
    if differences := describe_config_differences(before, now, extendable=True):
        sentence = f"The folder holds results of another suite, or of other code or versions: {differences}."
        fix = (
            "Name another --out, or go back to the suite, code and versions of these results (methods may be added). "
            f"{path}"
        )
        raise ConfigurationError.stating(sentence, fix=fix)


def describe_config_differences(before: dict[str, Any], now: dict[str, Any], *, extendable: bool = False) -> str:
    """The differences between two configurations, "" without any; entries that only `before` has do not count.

    If `extendable`, methods, planners and adapters may have been added.
    """
    differing = sorted(part for part in now if not _is_same(before.get(part), now[part], part, extendable))
    return "; ".join(_describe_difference(part, before.get(part), now[part], extendable) for part in differing)


def _describe_difference(part: str, before: Any, now: Any, extendable: bool) -> str:
    """The difference of one part of the configuration, entry by entry if it has entries."""
    if not (isinstance(before, dict) and isinstance(now, dict)):
        return f"{part} has changed"
    inner = before if extendable and part in EXTENDABLE_PARTS else before | now
    names = sorted(
        name for name in inner if name not in now or not _is_same(before.get(name), now[name], name, extendable)
    )
    return "; ".join(
        f"{part}.{name} is {_truncate(now.get(name))}, was {_truncate(before.get(name))}" for name in names
    )


def _truncate(value: Any) -> str:
    text = "nothing" if value is None else str(value)
    return text if len(text) <= MAX_VALUE_CHARACTERS else f"{text[:MAX_VALUE_CHARACTERS]}…"


def _is_same(before: Any, now: Any, name: str, extendable: bool) -> bool:
    return _is_extension(before, now, name) if extendable else before == now


def _is_extension(before: Any, now: Any, name: str = "") -> bool:
    """Whether `now` equals `before`; methods, planners and adapters may have been added."""
    if isinstance(before, dict) and isinstance(now, dict):
        names = before if name in EXTENDABLE_PARTS else before | now
        return all(one in before and one in now and _is_extension(before[one], now[one], one) for one in names)
    if isinstance(before, list) and name in EXTENDABLE_PARTS:
        return set(before) <= set(now)
    return before == now
