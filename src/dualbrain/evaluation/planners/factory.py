"""The planners behind the parts that methods ask for: opened once a process, at the first question."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from dualbrain.adaptation.adapters.naming import (
    ADAPTER_PREFIX,
    SHADOW_PREFIX,
    is_adapter,
    parse_shadow_name,
    strip_torch_prefix,
)
from dualbrain.adaptation.adapters.packaged import packaged_names
from dualbrain.adaptation.serving.open_planner import can_be_unconstrained, open_planner, open_unconstrained
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.evaluation.planners.adversary import Adversary
from dualbrain.evaluation.planners.answer_cache import AnswerCache, CachingPlanner
from dualbrain.evaluation.planners.corrupted_prompt import CorruptedPromptPlanner
from dualbrain.evaluation.planners.few_shot import FewShotPlanner
from dualbrain.evaluation.planners.template import TemplatePlanner
from dualbrain.evaluation.protocol.method import Method, PlannerRole
from dualbrain.evaluation.protocol.suite import Suite
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.planner import registry as plain
from dualbrain.planner.protocol import Planner

RANDOM_PLANNERS = ("template", "adversary")
"""Planners that draw their answers: there is nothing to wait for, and no latency to measure."""
CHAMPION_PLANNER = "adapter:champion"
PLANNER_ROLES = tuple(part for part in get_args(PlannerRole) if part not in RANDOM_PLANNERS)
"""What a suite names planners for, whether or not one of its methods asks for it."""
UNLISTED_NAME_FORMS = (
    f"{ADAPTER_PREFIX}ID",
    f"{ADAPTER_PREFIX}FOLDER",
    "transformers:NAME",
    "http://HOST/v1#MODEL",
    "FILE.gguf",
)
"""Names of planners that have no list."""


@dataclass(frozen=True, slots=True)
class PlannerSources:
    """Where planners come from: folder of weights, registry of adapters, key of a server."""

    cache: Path
    adapters: Path
    api_key: str = ""

    def open(self, name: str, robot: str, *, constrained: bool = True) -> Planner:
        """The planner called `name` for `robot`; an adapter that was not taught its vocabulary is refused."""
        if name == "template":
            return TemplatePlanner()
        if name == "adversary":
            return Adversary()
        prefixes = self.cache / "prefixes"
        prefixes.mkdir(parents=True, exist_ok=True)
        registry = load_skill_registry(robot).hash
        if not constrained:
            return open_unconstrained(name, self.cache, adapters=self.adapters, robot=robot, registry=registry)
        return open_planner(
            name,
            self.cache,
            adapters=self.adapters,
            robot=robot,
            registry=registry,
            key=self.api_key,
            prompt_cache=prefixes,
        )


def planner_name(suite: Suite, method: Method) -> str:
    """Who answers for `method`."""
    return method.planner_role if method.planner_role in RANDOM_PLANNERS else suite.planners[method.planner_role]


def check_planners(suite: Suite) -> None:
    """Refuse planners that are none, and a suite in which a method has nobody to ask: before it is flown.

    Raises `UnknownName`, `InvalidSetup`. Whether an adapter is here is not looked at (`parts.require_adapters`).
    """
    for part, planner in suite.planners.items():
        if part not in PLANNER_ROLES:
            raise UnknownNameError("part", part, PLANNER_ROLES, owner="a suite's planners")
        _require_known_planner(planner)
    if suite.memory.pilot and "base" not in suite.planners:
        raise ConfigurationError("planner of the pilot", got=sorted(suite.planners), allowed="base", fix="Name it.")
    for arm in suite.resolved_methods:
        if arm.planner_role not in (*suite.planners, "adversary"):
            fix = f"Name it: --planner {arm.planner_role}=adapter:ID (or in [planners] of the suite), or leave out {arm.name}."
            raise ConfigurationError(
                f"planners of suite {suite.name}", got=sorted(suite.planners), allowed=arm.planner_role, fix=fix
            )
        if not arm.constrained and not can_be_unconstrained(planner := suite.planners[arm.planner_role]):
            fix = f"Leave out {arm.name}."
            raise ConfigurationError(f"planner of {arm.name}", got=planner, allowed="one that runs here", fix=fix)
    if any(CHAMPION_PLANNER in underlying_planners(planner) for planner in suite.planners.values()):
        fix = "Name the adapter by its id: `dualbrain adapters list`."
        raise ConfigurationError(
            f"planners of suite {suite.name}", got=CHAMPION_PLANNER, allowed="what stays the same", fix=fix
        )


def underlying_planners(name: str) -> tuple[str, ...]:
    """All who are asked by the name of a planner, whatever runs them: a candidate in the shadow is asked too."""
    return tuple(map(strip_torch_prefix, parse_shadow_name(name) if name.startswith(SHADOW_PREFIX) else (name,)))


def _require_known_planner(name: str) -> None:
    """Raise `UnknownName` unless `name` means a planner, `InvalidSetup` for an address that leads nowhere."""
    for whole, core in zip(
        parse_shadow_name(name) if name.startswith(SHADOW_PREFIX) else (name,), underlying_planners(name), strict=True
    ):
        if core in plain.planner_names() or (is_adapter(core) and core != ADAPTER_PREFIX):
            continue
        alone = whole == core  # no other engine runs what is no model of ours
        if alone and "://" in core:
            plain.open_planner(core, Path()).close()  # looks at the address, and asks nobody
        elif not (alone and (name in RANDOM_PLANNERS or core.endswith(".gguf"))):
            known = (*RANDOM_PLANNERS, *plain.planner_names(), *packaged_names(), *UNLISTED_NAME_FORMS)
            raise UnknownNameError("planner", name, known, owner="the evaluation")


class PlannerFactory:
    """The planners of one suite in one process, each with the folder of kept answers before it."""

    def __init__(self, suite: Suite, sources: PlannerSources, cache: AnswerCache) -> None:
        """Nothing is opened yet."""
        self._suite, self._sources, self._cache = suite, sources, cache
        self._open: dict[tuple[str, str, bool], Planner] = {}
        self._caching: dict[tuple[str, str], CachingPlanner] = {}

    def get(self, method: Method, robot: str, *, constrained: bool = True) -> CachingPlanner:
        """The planner of `method` for `robot`, bound as it serves or by nothing; each way has answers of its own."""
        name, constrained = planner_name(self._suite, method), constrained and method.constrained
        words = [name, "with a worked example" * _uses_worked_example(method, name)]
        words += [
            f"prompt {method.prompt_corruption}" * (method.prompt_corruption != "no"),
            "bound by nothing" * (not constrained),
        ]
        key = (", ".join(filter(None, words)), robot)
        if key not in self._caching:
            self._caching[key] = CachingPlanner(
                key[0], self._cache, lambda: self._open_planner(name, robot, method, constrained)
            )
        return self._caching[key]

    def get_unconstrained(self, method: Method, robot: str) -> CachingPlanner | None:
        """The planner of `method` bound by nothing, None where that cannot be had."""
        return (
            self.get(method, robot, constrained=False)
            if can_be_unconstrained(planner_name(self._suite, method))
            else None
        )

    def _open_planner(self, name: str, robot: str, method: Method, bound: bool) -> Planner:
        if (name, robot, bound) not in self._open:
            self._open[name, robot, bound] = self._sources.open(name, robot, constrained=bound)
        planner = self._open[name, robot, bound]
        if _uses_worked_example(method, name):
            planner = FewShotPlanner(planner)
        return (
            planner if method.prompt_corruption == "no" else CorruptedPromptPlanner(planner, method.prompt_corruption)
        )

    def close(self) -> None:
        """Close what was opened."""
        for planner in self._open.values():
            planner.close()
        self._open.clear()
        self._caching.clear()


def _uses_worked_example(method: Method, name: str) -> bool:
    """Whether worked examples are shown: a full prompt has them, the short one of an adapter has not."""
    return method.planner_role == "prompted" and is_adapter(strip_torch_prefix(name))
