"""Results folders of evaluations: rows, configuration, suite, date, and the command that made them."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dualbrain.cli.common.console import StderrConsole
from dualbrain.cli.evaluation.suite_options import override_suite
from dualbrain.errors import ConfigurationError, DualbrainError

if TYPE_CHECKING:
    from dualbrain.evaluation.protocol.suite import Suite
    from dualbrain.evaluation.results.episode_row import EpisodeRow
    from dualbrain.evaluation.runner.runner import Runner

EPISODE_LOG = "fly.jsonl"
"""Log of the pass that runs the episodes."""
RUN_FILE = "episode.json"
"""File that only the folder of a single run contains."""
RUN_DATE_KEY = "flown"
"""Entry of the stored configuration: the date of the last episode."""


Results = tuple["list[EpisodeRow]", dict[str, Any], "Suite"]
"""Rows, configuration and suite of an evaluation."""


def print_omission(line: str) -> None:
    """Print what could not be read or shown."""
    StderrConsole().print(f"left out: {line}", markup=False, soft_wrap=True)


def load_results(folder: Path, on_omission: Callable[[str], None] | None = None) -> Results:
    """Rows, configuration and suite of the results in `folder`; of an unfinished evaluation, its finished episodes.

    Args:
        folder: The --out of `dualbrain evaluate`.
        on_omission: Receives a description of each part that cannot be read, if the rest can be read.

    Raises:
        ConfigurationError: nothing can be read, or a part cannot be read and `on_omission` is None.
    """
    from dualbrain.evaluation.results.parquet import RESULTS_FILE, read_results
    from dualbrain.evaluation.runner.runner import CONFIG_FILE, suite_from_config

    path, log = folder / RESULTS_FILE, folder / EPISODE_LOG
    if (folder / RUN_FILE).is_file() and not (log.is_file() or path.is_file()):
        raise ConfigurationError.stating(
            f"{folder} is the folder of a single run, not of an evaluation.",
            fix=f"The report of the run is {folder / 'report.html'}.",
        )
    if (folder / CONFIG_FILE).is_file() and log.is_file() and not _is_newer(path, log):
        try:
            found = _read_logs(folder, on_omission)
            if found[0]:
                return found
        except ConfigurationError as why:
            if on_omission is None or not path.is_file():
                raise
            on_omission(f"Episodes that finished after {RESULTS_FILE} was written ({why})")
    if not path.is_file():
        raise _no_results_error(folder)
    rows, config = read_results(path)
    return rows, config, suite_from_config(config, path)


def write_table(runner: Runner) -> int:
    """Write the finished episodes of `runner` to the table in its folder; the number of episodes."""
    from dualbrain.evaluation.results.parquet import RESULTS_FILE, write_results
    from dualbrain.evaluation.runner.runner import CONFIG_FILE, read_config

    rows = runner.rows()
    if rows:
        config = read_config(runner.out / CONFIG_FILE)
        write_results(rows, config | {RUN_DATE_KEY: last_run_date(runner.out, config)}, runner.out / RESULTS_FILE)
    return len(rows)


def _read_logs(folder: Path, on_omission: Callable[[str], None] | None) -> Results:
    """Rows, configuration and suite from the logs of the runner; raises `ConfigurationError`."""
    from dualbrain.evaluation.runner.runner import CONFIG_FILE, Runner, read_config, suite_from_config

    config = read_config(folder / CONFIG_FILE)
    suite = suite_from_config(config, folder / CONFIG_FILE)
    runner = Runner(suite, folder, clock=time.monotonic, on_progress=lambda progress: None)
    return runner.rows(on_omission), config, suite


def _no_results_error(folder: Path) -> ConfigurationError:
    """Error that states why `folder` contains no results, and the command that produces them."""
    from dualbrain.evaluation.results.parquet import RESULTS_FILE
    from dualbrain.evaluation.runner.runner import CONFIG_FILE, read_config, suite_from_config
    from dualbrain.visualization.evaluation.markdown_page import PAGE_FILE

    if folder.is_file():
        return ConfigurationError.stating(f"{folder} is a file, not a folder of results.", fix="Name its folder.")
    if (folder / CONFIG_FILE).is_file():
        suite = suite_from_config(read_config(folder / CONFIG_FILE), folder / CONFIG_FILE)
        return ConfigurationError.stating(
            f"{folder} contains no finished episode.", fix=f"Resume the evaluation: {resume_command(suite, folder)}"
        )
    if (folder / PAGE_FILE).is_file():
        return ConfigurationError.stating(
            f"{folder} contains a page without its table {RESULTS_FILE}.",
            fix=f"Run the command that the page states into another folder. {folder / PAGE_FILE}",
        )
    return ConfigurationError.stating(
        f"{folder} contains no results ({RESULTS_FILE}).",
        fix=f"Run the evaluation first: dualbrain evaluate --suite SUITE --out {folder}",
    )


def _is_newer(table: Path, log: Path) -> bool:
    """Whether the table was written after the last line of the log."""
    return table.is_file() and table.stat().st_mtime_ns >= log.stat().st_mtime_ns


def last_run_date(folder: Path, config: dict[str, Any]) -> str:
    """Date of the last episode (UTC): that of the log, or without a log the one in `config`."""
    from dualbrain.evaluation.results.parquet import RESULTS_FILE

    log = folder / EPISODE_LOG
    if RUN_DATE_KEY in config and not log.is_file():
        return str(config[RUN_DATE_KEY])
    written = (log if log.is_file() else folder / RESULTS_FILE).stat().st_mtime
    return datetime.fromtimestamp(written, UTC).strftime("%Y-%m-%d")


def reproduction_command(suite: Suite, folder: Path) -> str:
    """Command that runs `suite` into a folder of the same name: a built-in suite with the options that differ from it.

    For a suite that no options can reproduce, the command names a suite file.
    """
    return _command(suite, folder.name)


def resume_command(suite: Suite, folder: Path, part: str = "") -> str:
    """Command that resumes `suite` in `folder`, or only its `part` (`K/N`)."""
    return _command(suite, f"{folder} --part {part}" if part else str(folder))


def _command(suite: Suite, out: str) -> str:
    from dualbrain.evaluation.protocol.suite import builtin_suites, load_suite

    options: dict[str, str] = {}
    if suite.name in builtin_suites():
        builtin = load_suite(suite.name)
        others = {role: name for role, name in suite.planners.items() if builtin.planners.get(role) != name}
        options |= {"methods": ",".join(suite.methods)} if suite.methods != builtin.methods else {}
        options |= {"planner": ",".join(f"{role}={name}" for role, name in others.items())} if others else {}
        options |= {"robots": ",".join(suite.robots)} if suite.robots != builtin.robots else {}
        same_size = suite.episodes_per_task == builtin.episodes_per_task
        options |= {} if same_size else {"episodes": str(suite.episodes_per_task)}
        options |= {"target": suite.target} if suite.target else {}
        methods, robots, planner = (options.get(name, "") for name in ("methods", "robots", "planner"))
        with suppress(DualbrainError):  # this version may reject the suite of another version
            count, target = int(options.get("episodes", 0)), suite.target
            if override_suite(suite.name, methods, count, robots, planner, target=target) == suite:
                words = [word for name, value in options.items() for word in (f"--{name}", value)]
                return " ".join(["dualbrain evaluate --suite", suite.name, *words, "--out", out])
    return f"dualbrain evaluate --suite FILE.toml --out {out}  # FILE.toml: the suite in config.json there"
