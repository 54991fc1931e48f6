"""A pytest plugin for the mutation check: tests in a given order, each verdict on disk at once, no shrinking.

Options: --order FILE (JSON list of node ids that go first, in this order), --verdicts FILE (JSON lines: a test when it
starts, and when it ends with its outcome and seconds; `cpu` is the process's own time so far). What comes last in the
file tells what a crash happened in.
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
    """Where the order is read from and the verdicts go to."""
    parser.addoption("--order", default="", help="JSON list of node ids that go first")
    parser.addoption("--verdicts", default="", help="JSON lines of what each test did")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Known tests in the given order, then the others."""
    path = config.getoption("--order")
    rank = {name: i for i, name in enumerate(json.loads(Path(path).read_text()))} if path else {}
    items.sort(key=lambda item: rank.get(item.nodeid, len(rank)))


def pytest_runtest_logstart(nodeid: str) -> None:
    """The test that a crash or a timeout will be blamed on."""
    _write({"test": nodeid})


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Outcome and seconds, of the call or of a broken set-up."""
    if report.when == "call" or report.outcome == "failed":
        _write({"test": report.nodeid, "outcome": report.outcome, "seconds": round(report.duration, 4)})


_verdict_files: list[str] = []


def pytest_configure(config: pytest.Config) -> None:
    """Remember where the verdicts go."""
    _verdict_files.append(config.getoption("--verdicts"))


def _write(row: dict[str, object]) -> None:
    if _verdict_files and _verdict_files[-1]:
        with Path(_verdict_files[-1]).open("a") as file:
            file.write(json.dumps({**row, "cpu": round(time.process_time(), 3)}) + "\n")
