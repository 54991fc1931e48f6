"""Experiments: units of work by key, the row that one unit leaves, and the tables that are made of all rows."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from dualbrain.evaluation.runner.worker_pool import UnitRunner

Row = dict[str, Any]
"""Result of one unit as JSON: at least `key`; `error` if the unit failed."""


@dataclass(frozen=True, slots=True)
class WorkUnit:
    """One piece of work: its `key` in the log, and its `parameters` (JSON)."""

    key: str
    parameters: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Options:
    """Options of all experiments: the `folder` of the logs, and the name of the `planner` under test."""

    folder: Path
    planner: str


class Experiment(Protocol):
    """One claim and the work that tests it.

    An experiment may also have an attribute `intervals`, which describes the intervals in its tables; without it they
    are Wilson's (`figures.tables`).
    """

    name: str
    claim: str

    def units(self, options: Options) -> list[WorkUnit]:
        """All units, the most informative first, so that any prefix is an unbiased sample."""
        ...

    def run(self, parameters: dict[str, Any]) -> Row:
        """Carry out the unit with its `parameters`; a worker process may carry out many."""
        ...

    def summarize_row(self, row: Row) -> str:
        """One row in a few words, for the progress line."""
        ...

    def report(self, rows: list[Row]) -> list[str]:
        """Tables and exceptions as lines of Markdown."""
        ...


def group_of(experiment: Experiment) -> str:
    """The group of an experiment: the package that its module is in."""
    return type(experiment).__module__.split(".")[1]


def unit_runner(experiment: Experiment) -> UnitRunner[WorkUnit]:
    """Carries out a unit and yields its row, with the wall time that it took [s] and the machine's load after it."""

    def run(unit: WorkUnit) -> Iterator[Row]:
        start = time.monotonic()
        row = experiment.run(unit.parameters)
        load = round(os.getloadavg()[0], 2)
        yield {"key": unit.key, **row, "wall_s": round(time.monotonic() - start, 2), "load": load}

    return run
