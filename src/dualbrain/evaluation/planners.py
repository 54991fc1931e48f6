"""The planners behind the parts that methods ask for: opened once a process, at the first question."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dualbrain.evaluation.adversary import Adversary
from dualbrain.evaluation.method import Method
from dualbrain.evaluation.plans import KeepingPlanner, Plans
from dualbrain.evaluation.spoiled import SpoiledPlanner
from dualbrain.evaluation.suite import Suite
from dualbrain.evaluation.template import TemplatePlanner
from dualbrain.planner.protocol import Planner
from dualbrain.planner.registry import open_planner

DRAWN = ("template", "adversary")
"""Planners that draw their answers: there is nothing to wait for, and no latency to measure."""


@dataclass(frozen=True, slots=True)
class Sources:
    """Where planners come from: folder of weights, key of a server."""

    cache: Path
    key: str = ""

    def open(self, name: str) -> Planner:
        """The planner called `name`."""
        if name == "template":
            return TemplatePlanner()
        if name == "adversary":
            return Adversary()
        prefixes = self.cache / "prefixes"
        prefixes.mkdir(parents=True, exist_ok=True)
        return open_planner(name, self.cache, key=self.key, prefixes=prefixes)


def planner_name(suite: Suite, method: Method) -> str:
    """Who answers for `method`."""
    return "adversary" if method.asks == "adversary" else suite.planners[method.asks]


class Planners:
    """The planners of one suite in one process, each with the folder of kept answers before it."""

    def __init__(self, suite: Suite, sources: Sources, plans: Plans) -> None:
        """Nothing is opened yet."""
        self._suite, self._sources, self._plans = suite, sources, plans
        self._open: dict[str, Planner] = {}
        self._kept: dict[tuple[str, str], KeepingPlanner] = {}

    def of(self, method: Method) -> KeepingPlanner:
        """The planner of `method`; spoiled prompts have answers of their own."""
        name = planner_name(self._suite, method)
        key = (name, method.spoiled)
        if key not in self._kept:
            id = name if method.spoiled == "no" else f"{name}, prompt {method.spoiled}"
            self._kept[key] = KeepingPlanner(id, self._plans, lambda: self._planner(name, method))
        return self._kept[key]

    def _planner(self, name: str, method: Method) -> Planner:
        if name not in self._open:
            self._open[name] = self._sources.open(name)
        whole = self._open[name]
        return whole if method.spoiled == "no" else SpoiledPlanner(whole, method.spoiled)

    def close(self) -> None:
        """Close what was opened."""
        for planner in self._open.values():
            planner.close()
        self._open.clear()
        self._kept.clear()
