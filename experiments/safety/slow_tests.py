"""The slow tests of the test suite, one after another, with their output."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import format_proportion, markdown_table

ROOT = Path(__file__).resolve().parents[2]
PYTEST_COMMAND = [
    sys.executable,
    "-m",
    "pytest",
    "-q",
    "-m",
    "slow",
    "-p",
    "no:cacheprovider",
    "-o",
    "addopts=--strict-markers",
]


class SlowTests:
    """The tests with the pytest marker `slow`; a test that needs a package that is not installed (TRL) is no unit."""

    name = "slow_tests"
    claim = (
        "Every test marked slow passes: adversarial closed loops, the QP against independent solvers, bitwise equal "
        "builds."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """One unit per test function; its parameters run together."""
        del options
        listing = subprocess.run(
            [*PYTEST_COMMAND, "--collect-only", "tests"], cwd=ROOT, capture_output=True, text=True, check=False
        ).stdout
        tests = [line for line in listing.splitlines() if re.match(r"tests/\S+\.py::", line)]
        names = dict.fromkeys(test.split("[")[0] for test in tests)
        return [WorkUnit(name, {"test": name}) for name in names]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Run one test; pytest's last line is its count, the lines before it are the output of the test."""
        done = subprocess.run(
            [*PYTEST_COMMAND, "-rP", parameters["test"]], cwd=ROOT, capture_output=True, text=True, check=False
        )
        lines = done.stdout.strip().splitlines()
        output = [line for line in lines if line and not re.match(r"[=_. ]|\w+ tests/|PASSED|-{5,}", line)]
        return {
            "passed": done.returncode == 0,
            "result": re.sub(r"=+ ?", "", lines[-1] if lines else ""),
            "said": output[-12:-1] if done.returncode == 0 else lines[-30:],
        }

    def summarize_row(self, row: Row) -> str:
        """Pytest's count."""
        return row["result"]

    def report(self, rows: list[Row]) -> list[str]:
        """Every test with pytest's count and its output."""
        good = sum(row["passed"] for row in rows)
        cells = (
            (f"`{row['key']}`", row["result"], "<br>".join(row["said"]) if row["passed"] else "failed") for row in rows
        )
        return [
            f"Passed: **{format_proportion(good, len(rows))}**.",
            "",
            *markdown_table(("test", "result", "output"), cells),
        ]
