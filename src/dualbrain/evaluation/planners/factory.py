"""The planners behind the parts that methods ask for: opened once a process, at the first question."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from dualbrain.adaptation.adapters.naming import PREFIX, SHADOW, is_adapter, shadow_parts, without_engine
from dualbrain.adaptation.adapters.packaged import packaged_names
from dualbrain.adaptation.serving.open_planner import open_planner, open_unbound, unbinds
from dualbrain.errors import InvalidSetup, UnknownName
from dualbrain.evaluation.planners.adversary import Adversary
from dualbrain.evaluation.planners.answer_cache import KeepingPlanner, Plans
from dualbrain.evaluation.planners.corrupted_prompt import SpoiledPlanner
from dualbrain.evaluation.planners.few_shot import PromptedPlanner
from dualbrain.evaluation.planners.template import TemplatePlanner
from dualbrain.evaluation.protocol.method import Asks, Method
from dualbrain.evaluation.protocol.suite import Suite
from dualbrain.grounding.vocabulary import vocabulary
from dualbrain.planner import registry as plain
from dualbrain.planner.protocol import Planner

DRAWN = ("template", "adversary")
"""Planners that draw their answers: there is nothing to wait for, and no latency to measure."""
CHANGING = "adapter:champion"
PARTS = tuple(part for part in get_args(Asks) if part not in DRAWN)
"""What a suite names planners for, whether or not one of its methods asks for it."""
ALSO = (f"{PREFIX}ID", f"{PREFIX}FOLDER", "transformers:NAME", "http://HOST/v1#MODEL", "FILE.gguf")
"""Names of planners that have no list."""


@dataclass(frozen=True, slots=True)
class Sources:
    """Where planners come from: folder of weights, registry of adapters, key of a server."""

    cache: Path
    adapters: Path
    key: str = ""

    def open(self, name: str, robot: str, *, bound: bool = True) -> Planner:
        """The planner called `name` for `robot`; an adapter that was not taught its vocabulary is refused."""
        if name == "template":
            return TemplatePlanner()
        if name == "adversary":
            return Adversary()
        prefixes = self.cache / "prefixes"
        prefixes.mkdir(parents=True, exist_ok=True)
        registry = vocabulary(robot).hash
        if not bound:
            return open_unbound(name, self.cache, adapters=self.adapters, robot=robot, registry=registry)
        return open_planner(
            name, self.cache, adapters=self.adapters, robot=robot, registry=registry, key=self.key, prefixes=prefixes
        )  # fmt: skip


def planner_name(suite: Suite, method: Method) -> str:
    """Who answers for `method`."""
    return method.asks if method.asks in DRAWN else suite.planners[method.asks]


def check_planners(suite: Suite) -> None:
    """Refuse planners that are none, and a suite in which a method has nobody to ask: before it is flown.

    Raises `UnknownName`, `InvalidSetup`. Whether an adapter is here is not looked at (`parts.require_adapters`).
    """
    for part, planner in suite.planners.items():
        if part not in PARTS:
            raise UnknownName("part", part, PARTS, owner="a suite's planners")
        _require_planner(planner)
    if suite.memory.pilot and "base" not in suite.planners:
        raise InvalidSetup("planner of the pilot", got=sorted(suite.planners), allowed="base", fix="Name it.")
    for arm in suite.arms:
        if arm.asks not in (*suite.planners, "adversary"):
            fix = f"Name it: --planner {arm.asks}=adapter:ID (or in [planners] of the suite), or leave out {arm.name}."
            raise InvalidSetup(f"planners of suite {suite.name}", got=sorted(suite.planners), allowed=arm.asks, fix=fix)
        if not arm.bound and not unbinds(planner := suite.planners[arm.asks]):
            fix = f"Leave out {arm.name}."
            raise InvalidSetup(f"planner of {arm.name}", got=planner, allowed="one that runs here", fix=fix)
    if any(CHANGING in asked_behind(planner) for planner in suite.planners.values()):
        fix = "Name the adapter by its id: `dualbrain adapters list`."
        raise InvalidSetup(f"planners of suite {suite.name}", got=CHANGING, allowed="what stays the same", fix=fix)


def asked_behind(name: str) -> tuple[str, ...]:
    """All who are asked by the name of a planner, whatever runs them: a candidate in the shadow is asked too."""
    return tuple(map(without_engine, shadow_parts(name) if name.startswith(SHADOW) else (name,)))


def _require_planner(name: str) -> None:
    """Raise `UnknownName` unless `name` means a planner, `InvalidSetup` for an address that leads nowhere."""
    for whole, core in zip(shadow_parts(name) if name.startswith(SHADOW) else (name,), asked_behind(name), strict=True):
        if core in plain.planner_names() or (is_adapter(core) and core != PREFIX):
            continue
        alone = whole == core  # no other engine runs what is no model of ours
        if alone and "://" in core:
            plain.open_planner(core, Path()).close()  # looks at the address, and asks nobody
        elif not (alone and (name in DRAWN or core.endswith(".gguf"))):
            known = (*DRAWN, *plain.planner_names(), *packaged_names(), *ALSO)
            raise UnknownName("planner", name, known, owner="the evaluation")


class Planners:
    """The planners of one suite in one process, each with the folder of kept answers before it."""

    def __init__(self, suite: Suite, sources: Sources, plans: Plans) -> None:
        """Nothing is opened yet."""
        self._suite, self._sources, self._plans = suite, sources, plans
        self._open: dict[tuple[str, str, bool], Planner] = {}
        self._kept: dict[tuple[str, str], KeepingPlanner] = {}

    def of(self, method: Method, robot: str, *, bound: bool = True) -> KeepingPlanner:
        """The planner of `method` for `robot`, bound as it serves or by nothing; each way has answers of its own."""
        name, bound = planner_name(self._suite, method), bound and method.bound
        words = [name, "with a worked example" * _prompted(method, name)]
        words += [f"prompt {method.spoiled}" * (method.spoiled != "no"), "bound by nothing" * (not bound)]
        key = (", ".join(filter(None, words)), robot)
        if key not in self._kept:
            self._kept[key] = KeepingPlanner(key[0], self._plans, lambda: self._planner(name, robot, method, bound))
        return self._kept[key]

    def unbound(self, method: Method, robot: str) -> KeepingPlanner | None:
        """The planner of `method` bound by nothing, None where that cannot be had."""
        return self.of(method, robot, bound=False) if unbinds(planner_name(self._suite, method)) else None

    def _planner(self, name: str, robot: str, method: Method, bound: bool) -> Planner:
        if (name, robot, bound) not in self._open:
            self._open[name, robot, bound] = self._sources.open(name, robot, bound=bound)
        planner = self._open[name, robot, bound]
        if _prompted(method, name):
            planner = PromptedPlanner(planner)
        return planner if method.spoiled == "no" else SpoiledPlanner(planner, method.spoiled)

    def close(self) -> None:
        """Close what was opened."""
        for planner in self._open.values():
            planner.close()
        self._open.clear()
        self._kept.clear()


def _prompted(method: Method, name: str) -> bool:
    """Whether worked examples are shown: a full prompt has them, the short one of an adapter has not."""
    return method.asks == "prompted" and is_adapter(without_engine(name))
