"""A pytest plugin for the mutation test: tests in a given order, verdicts written at once, no shrinking.

Options: --order FILE (JSON list of node ids that run first, in this order), --verdicts FILE (JSON lines: one at the
start of a test, one at its end with outcome and seconds; `cpu` is the processor time of the process so far). After a
crash, the last line names the test in which it happened.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest
from hypothesis import Phase, settings

settings.register_profile("mutants", phases=(Phase.explicit, Phase.generate), database=None, derandomize=True)
settings.load_profile("mutants")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options for the order and the verdicts."""
    parser.addoption("--order", default="", help="file with a JSON list of node ids that run first")
    parser.addoption("--verdicts", default="", help="file for the JSON lines of the verdicts")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Sort the known tests in the given order, before the others."""
    path = config.getoption("--order")
    rank = {name: i for i, name in enumerate(json.loads(Path(path).read_text()))} if path else {}
    items.sort(key=lambda item: rank.get(item.nodeid, len(rank)))


def pytest_runtest_logstart(nodeid: str) -> None:
    """Write the test that starts, to which a crash or a timeout is attributed."""
    _write({"test": nodeid})


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Write outcome and seconds of a call, or of a failed setup or teardown."""
    if report.when == "call" or report.outcome == "failed":
        _write({"test": report.nodeid, "outcome": report.outcome, "seconds": round(report.duration, 4)})


_verdict_files: list[str] = []


def pytest_configure(config: pytest.Config) -> None:
    """Store the path of the verdicts."""
    _verdict_files.append(config.getoption("--verdicts"))


def _write(row: dict[str, object]) -> None:
    if _verdict_files and _verdict_files[-1]:
        with Path(_verdict_files[-1]).open("a") as file:
            file.write(json.dumps({**row, "cpu": round(time.process_time(), 3)}) + "\n")
