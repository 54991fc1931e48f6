"""Results folders of evaluations: rows, configuration, suite, date, and the command that made them."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dualbrain.cli.common.console import StderrConsole
from dualbrain.cli.evaluation.suite_options import override_suite
from dualbrain.errors import ConfigurationError, DualbrainError

RUN_DATE_KEY = "flown"
"""Entry of a table's configuration: the day of its last flight."""


def print_omission(line: str) -> None:
    """Tell a person what could not be read, or is not there to be shown."""
    StderrConsole().print(f"left out: {line}", markup=False, soft_wrap=True)


def load_results(
    folder: Path, on_omission: Callable[[str], None] | None = None
) -> tuple[list[Any], dict[str, Any], Any]:
    """Rows, configuration and suite of the results in `folder`; of a run under way, what is done of it.

    `left_out` is told of what cannot be read where the rest can be; without it, and where nothing can be read, raises
    `InvalidSetup`.
    """
    from dualbrain.evaluation.results.parquet import RESULTS_FILE, read_results
    from dualbrain.evaluation.runner.runner import CONFIG_FILE, suite_from_config

    path, journal = folder / RESULTS_FILE, folder / "fly.jsonl"
    if (folder / CONFIG_FILE).is_file() and journal.is_file() and not _is_newer(path, journal):
        try:
            found = _read_logs(folder, on_omission)
            if found[0]:
                return found
        except ConfigurationError as why:
            if on_omission is None or not path.is_file():
                raise
            on_omission(f"What was flown since {RESULTS_FILE} was written ({why})")
    if not path.is_file():
        raise _no_results_error(folder)
    rows, config = read_results(path)
    return rows, config, suite_from_config(config, path)


def _read_logs(folder: Path, left_out: Callable[[str], None] | None) -> tuple[list[Any], dict[str, Any], Any]:
    """Rows, configuration and suite as the journals have them; raises `InvalidSetup`."""
    from dualbrain.evaluation.runner.runner import CONFIG_FILE, Runner, read_config, suite_from_config

    config = read_config(folder / CONFIG_FILE)
    suite = suite_from_config(config, folder / CONFIG_FILE)
    runner = Runner(suite, folder, clock=time.monotonic, on_progress=lambda progress: None)
    return runner.rows(left_out), config, suite


def _no_results_error(folder: Path) -> ConfigurationError:
    """Why there are no results in `folder`, and by which command they come."""
    from dualbrain.evaluation.results.parquet import RESULTS_FILE
    from dualbrain.evaluation.runner.runner import CONFIG_FILE, read_config, suite_from_config
    from dualbrain.visualization.evaluation.markdown_page import PAGE_FILE

    got, fix = "none", f"Fly them first: dualbrain evaluate --suite SUITE --out {folder}"
    if folder.is_file():
        got, fix = "a file", "Name the folder that it lies in."
    elif (folder / CONFIG_FILE).is_file():
        suite = suite_from_config(read_config(folder / CONFIG_FILE), folder / CONFIG_FILE)
        got, fix = "no episode that is finished", f"Go on with it: {_command(suite, str(folder))}"
    elif (folder / PAGE_FILE).is_file():
        got = "a page without its table"
        fix = f"The page names the command by which it was flown: fly that into another folder. {folder / PAGE_FILE}"
    return ConfigurationError("results", got=got, allowed=f"a folder with {RESULTS_FILE}", fix=fix)


def _is_newer(table: Path, journal: Path) -> bool:
    """Whether the table was written after the last line of the journal."""
    return table.is_file() and table.stat().st_mtime_ns >= journal.stat().st_mtime_ns


def last_run_date(folder: Path, config: dict[str, Any]) -> str:
    """The day on which the last episode was flown, UTC: by the journal, or without one as the table's `config` says."""
    from dualbrain.evaluation.results.parquet import RESULTS_FILE

    journal = folder / "fly.jsonl"
    if RUN_DATE_KEY in config and not journal.is_file():
        return str(config[RUN_DATE_KEY])
    written = (journal if journal.is_file() else folder / RESULTS_FILE).stat().st_mtime
    return datetime.fromtimestamp(written, UTC).strftime("%Y-%m-%d")


def reproduction_command(suite: Any, folder: Path) -> str:
    """The command that flies `suite` into a folder of that name: one that is shipped, with all that differs from it.

    What no options lead to came from a file.
    """
    return _command(suite, folder.name)


def _command(suite: Any, out: str) -> str:
    from dualbrain.evaluation.protocol.suite import builtin_suites, load_suite

    options: dict[str, str] = {}
    if suite.name in builtin_suites():
        ours = load_suite(suite.name)
        others = {part: name for part, name in suite.planners.items() if ours.planners.get(part) != name}
        options |= {"methods": ",".join(suite.methods)} if suite.methods != ours.methods else {}
        options |= {"planner": ",".join(f"{part}={name}" for part, name in others.items())} if others else {}
        options |= {"robots": ",".join(suite.robots)} if suite.robots != ours.robots else {}
        options |= {"episodes": str(suite.episodes)} if suite.episodes != ours.episodes_per_task else {}
        again = {name: options.get(name, "") for name in ("methods", "robots", "planner")}
        with suppress(DualbrainError):  # what was flown by another version may be refused by this one
            if override_suite(suite.name, episodes=int(options.get("episodes", 0)), **again) == suite:
                said = [word for name, value in options.items() for word in (f"--{name}", value)]
                return " ".join(["dualbrain evaluate --suite", suite.name, *said, "--out", out])
    return f"dualbrain evaluate --suite FILE.toml --out {out}  # FILE.toml: the suite in {out}/config.json"
