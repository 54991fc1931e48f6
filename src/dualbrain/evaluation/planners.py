"""The planners behind the parts that methods ask for: opened once a process, at the first question."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dualbrain.adaptation.serving.opening import open_planner
from dualbrain.evaluation.adversary import Adversary
from dualbrain.evaluation.method import Method
from dualbrain.evaluation.plans import KeepingPlanner, Plans
from dualbrain.evaluation.spoiled import SpoiledPlanner
from dualbrain.evaluation.suite import Suite
from dualbrain.evaluation.template import TemplatePlanner
from dualbrain.planner.protocol import Planner
from dualbrain.runtime.vocabulary import vocabulary

DRAWN = ("template", "adversary")
"""Planners that draw their answers: there is nothing to wait for, and no latency to measure."""


@dataclass(frozen=True, slots=True)
class Sources:
    """Where planners come from: folder of weights, registry of adapters, key of a server."""

    cache: Path
    adapters: Path
    key: str = ""

    def open(self, name: str, robot: str) -> Planner:
        """The planner called `name` for `robot`; an adapter that was not taught its vocabulary is refused."""
        if name == "template":
            return TemplatePlanner()
        if name == "adversary":
            return Adversary()
        prefixes = self.cache / "prefixes"
        prefixes.mkdir(parents=True, exist_ok=True)
        registry = vocabulary(robot).hash
        return open_planner(
            name, self.cache, adapters=self.adapters, robot=robot, registry=registry, key=self.key, prefixes=prefixes
        )  # fmt: skip


def planner_name(suite: Suite, method: Method) -> str:
    """Who answers for `method`."""
    return "adversary" if method.asks == "adversary" else suite.planners[method.asks]


class Planners:
    """The planners of one suite in one process, each with the folder of kept answers before it."""

    def __init__(self, suite: Suite, sources: Sources, plans: Plans) -> None:
        """Nothing is opened yet."""
        self._suite, self._sources, self._plans = suite, sources, plans
        self._open: dict[tuple[str, str], Planner] = {}
        self._kept: dict[tuple[str, str, str], KeepingPlanner] = {}

    def of(self, method: Method, robot: str) -> KeepingPlanner:
        """The planner of `method` for `robot`; spoiled prompts have answers of their own."""
        name = planner_name(self._suite, method)
        key = (name, robot, method.spoiled)
        if key not in self._kept:
            id = name if method.spoiled == "no" else f"{name}, prompt {method.spoiled}"
            self._kept[key] = KeepingPlanner(id, self._plans, lambda: self._planner(name, robot, method))
        return self._kept[key]

    def _planner(self, name: str, robot: str, method: Method) -> Planner:
        if (name, robot) not in self._open:
            self._open[name, robot] = self._sources.open(name, robot)
        whole = self._open[name, robot]
        return whole if method.spoiled == "no" else SpoiledPlanner(whole, method.spoiled)

    def close(self) -> None:
        """Close what was opened."""
        for planner in self._open.values():
            planner.close()
        self._open.clear()
        self._kept.clear()
