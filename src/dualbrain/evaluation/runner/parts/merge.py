"""Merge of the parts of an evaluation into one results folder, which is then like that of a single run.

Rows are deterministic, so a merge is a union by key. Rows of the same key that differ in more than their wall times,
for example pilot episodes on different processors, are an error: the parts did not run the same evaluation.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.core.storage.jsonl_log import JsonlLog, encode_line
from dualbrain.core.storage.resumable_steps import exclusive_folder
from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.evaluation.protocol.suite import Suite
from dualbrain.evaluation.runner.parts.part import Part
from dualbrain.evaluation.runner.parts.preparation import copy_new_files
from dualbrain.evaluation.runner.runner import (
    CONFIG_FILE,
    EPSILON_FILE,
    HOST_KEY,
    PART_KEY,
    STAGES,
    Runner,
    describe_config_differences,
    read_config,
    read_epsilon,
    suite_from_config,
)
from dualbrain.evaluation.runner.worker import (
    ANSWERS_FOLDER,
    COUNTERFACTUALS_FOLDER,
    EPISODE_CACHE_FOLDER,
    RUNS_FOLDER,
    START_FOLDER,
)

UNCOMPARED_FIELDS = frozenset({"planner_s", "gate_s", "filter_us", "wall_s", "wall", "asked", "ledger"})
"""Fields of a row that depend on the machine of the run: wall times, whether the planner's time was measured, and the
hash of the ledger, whose episodes contain wall times.
"""
COPIED_FOLDERS = (ANSWERS_FOLDER, COUNTERFACTUALS_FOLDER, EPISODE_CACHE_FOLDER, START_FOLDER, RUNS_FOLDER)


@dataclass(frozen=True, slots=True)
class MergeReport:
    """The suite of the parts, and of every part the number of episodes that are not finished."""

    suite: Suite
    unfinished: dict[Part, int]


def merge_parts(out: Path) -> MergeReport:
    """Merge the parts in `out` into `out`; a second call adds the episodes that were finished in the meantime.

    Raises:
        MissingDependencyError: `out` contains no part.
        ConfigurationError: the parts have different configurations or rows, another process works on one of them, or
            `out` holds results of another configuration.
    """
    folders = _part_folders(out)
    with ExitStack() as locks:
        for folder in (out, *folders.values()):
            locks.enter_context(exclusive_folder(folder, wait=False))
        config = _common_config(out, folders)
        suite = suite_from_config(config, next(iter(folders.values())) / CONFIG_FILE)
        logs = {stage: _merged_log(out, folders.values(), f"{stage}.jsonl") for stage in STAGES}
        epsilon = _merged_epsilon(out, folders.values())
        for folder in folders.values():
            copy_new_files(folder, out, COPIED_FOLDERS)
        if epsilon:
            write_atomically(out / EPSILON_FILE, msgspec.json.encode(epsilon))
        write_atomically(out / CONFIG_FILE, msgspec.json.format(msgspec.json.encode(config), indent=2))
        for stage, lines in logs.items():
            if lines:
                write_atomically(out / f"{stage}.jsonl", b"".join(map(encode_line, lines)))
    count = next(iter(folders)).count
    parts = [Part(count, number) for number in range(1, count + 1)]
    return MergeReport(suite, {part: _n_unfinished(suite, out, part) for part in parts})


def _part_folders(out: Path) -> dict[Part, Path]:
    """The folders of the parts in `out` that were started; raises if there are none, or of different divisions."""
    named = [(part, path) for path in out.glob("part-*") if (part := Part.of_folder(path))]
    found = {part: path for part, path in sorted(named) if (path / CONFIG_FILE).is_file()}
    if not found:
        fix = "Run them first, each with its own number: dualbrain evaluate --suite SUITE --out DIR --part 1/N"
        raise MissingDependencyError(f"A part of an evaluation in {out}", fix=fix)
    if len(counts := sorted({part.count for part in found})) > 1:
        raise ConfigurationError.stating(
            f"{out} contains parts of different divisions: N is {', '.join(map(str, counts))}.",
            fix="Move the folders of one of the divisions elsewhere.",
        )
    return found


def _common_config(out: Path, folders: dict[Part, Path]) -> dict[str, Any]:
    """The configuration of all parts, with the machines of all; raises `ConfigurationError` if it is not the same."""
    configs = {part: read_config(folder / CONFIG_FILE) for part, folder in folders.items()}
    first = min(configs)
    for part, config in configs.items():
        if config.get(PART_KEY) != str(part):
            fix = f"Rename it to its part, or remove it. {folders[part]}"
            raise ConfigurationError.stating(f"The folder holds part {config.get(PART_KEY)}, not {part}.", fix=fix)
        _require_equal(configs[first], config, f"Parts {first} and {part}")
    if (out / CONFIG_FILE).is_file():
        _require_equal(configs[first], read_config(out / CONFIG_FILE), f"Part {first} and the results in {out}")
    hosts = [config.get(HOST_KEY, {}) for config in configs.values()]
    names = dict.fromkeys(name for host in hosts for name in host)
    joined = {name: "; ".join(sorted({str(host[name]) for host in hosts if name in host})) for name in names}
    return _comparable(configs[first]) | {HOST_KEY: joined}


def _require_equal(one: dict[str, Any], other: dict[str, Any], which: str) -> None:
    if differences := describe_config_differences(_comparable(other), _comparable(one)):
        raise ConfigurationError.stating(
            f"{which} have different configurations: {differences}.",
            fix="Run them with the same suite, code and versions, and merge only parts of one evaluation.",
        )


def _comparable(config: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in config.items() if key not in (HOST_KEY, PART_KEY)}


def _merged_log(out: Path, folders: Iterable[Path], name: str) -> list[dict[str, Any]]:
    """The lines of all logs called `name`, one for each key; raises `ConfigurationError` if two of a key differ."""
    found: dict[str, tuple[dict[str, Any], Path]] = {}
    for folder in (out, *folders):
        log = JsonlLog(folder / name)
        for line in log.latest():
            known, path = found.setdefault(line["key"], (line, log.path))
            if differing := _differing_fields(known, line):
                raise ConfigurationError.stating(
                    f"The episode {line['key']!r} differs between {path} and {log.path} in {', '.join(differing)}.",
                    fix="Machines can decide near-ties of a language model differently. Compute the pilot episodes and "
                    "start ledgers once, with --prepare-only, and run the parts from there.",
                )
    return [line for line, _ in found.values()]


def _differing_fields(one: dict[str, Any], other: dict[str, Any]) -> list[str]:
    """Fields that differ, apart from wall times (compared as JSON, so that two NaN are equal)."""
    names = sorted((one.keys() | other.keys()) - UNCOMPARED_FIELDS)
    return [name for name in names if encode_line({"": one.get(name)}) != encode_line({"": other.get(name)})]


def _merged_epsilon(out: Path, folders: Iterable[Path]) -> dict[str, float]:
    """ε by robot of all parts; raises `ConfigurationError` if two parts used different values."""
    found: dict[str, float] = {}
    for path in (folder / EPSILON_FILE for folder in (out, *folders)):
        for robot, value in (read_epsilon(path) if path.is_file() else {}).items():
            if found.setdefault(robot, value) != value:
                raise ConfigurationError.stating(
                    f"The parts used different ε for {robot}: {found[robot]} and {value} ({path}).",
                    fix="Compute it once, with --prepare-only, and run the parts from there.",
                )
    return found


def _n_unfinished(suite: Suite, out: Path, part: Part) -> int:
    runner = Runner(suite, out, clock=time.monotonic, on_progress=lambda progress: None, part=part)
    return sum(unit.n_episodes - unit.done for unit in runner.remaining_units("fly"))
