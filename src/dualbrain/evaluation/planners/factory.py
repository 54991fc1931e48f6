"""Opens the planners behind the planner roles of methods, once per process, at the first request."""

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
from dualbrain.core.storage.private_files import open_private_folder
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.evaluation.planners.adversary import Adversary
from dualbrain.evaluation.planners.answer_cache import AnswerCache, CachingPlanner
from dualbrain.evaluation.planners.corrupted_prompt import CorruptedPromptPlanner
from dualbrain.evaluation.planners.few_shot import BEST_FIXED, NO_CHANGE, FewShotPlanner
from dualbrain.evaluation.planners.template import TemplatePlanner
from dualbrain.evaluation.planners.value_planner import VALUE_PREFIX, load_value_planner, value_model_digest
from dualbrain.evaluation.protocol.method import Method, PlannerRole
from dualbrain.evaluation.protocol.suite import Suite
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.planner import registry as planner_registry
from dualbrain.planner.backends.key_redaction import has_secret_parts, public_planner
from dualbrain.planner.protocol import Planner

RANDOM_PLANNERS = ("template", "adversary")
"""Planners with random answers: they are instantaneous, so no latency is measured."""
CHAMPION_PLANNER = "adapter:champion"
FIXED_ROLE: PlannerRole = "prompted_fixed"
"""The role of method PE-fixed."""
PLANNER_ROLES = tuple(part for part in get_args(PlannerRole) if part not in RANDOM_PLANNERS)
"""Roles for which a suite may name a planner, whether or not one of its methods uses the role."""
UNLISTED_NAME_FORMS = (
    f"{ADAPTER_PREFIX}ID",
    f"{ADAPTER_PREFIX}FOLDER",
    "transformers:NAME",
    "http://HOST/v1#MODEL",
    "FILE.gguf",
    f"{VALUE_PREFIX}FILE.json",
)
"""Forms of planner names that are not listed."""


@dataclass(frozen=True, slots=True)
class PlannerSources:
    """Sources of planners: folder of model weights, registry of adapters, API key of a server."""

    cache: Path
    adapters: Path
    api_key: str = ""

    def open(self, name: str, robot: str, *, constrained: bool = True) -> Planner:
        """The planner called `name` for `robot`, with constrained decoding unless `constrained` is False.

        Raises `ConfigurationError` for an adapter that was not trained on the robot's skills, and as `open_planner`.
        """
        if name == "template":
            return TemplatePlanner()
        if name == "adversary":
            return Adversary()
        if name.startswith(VALUE_PREFIX):
            return load_value_planner(name)
        prefixes = self.cache / "prefixes"
        open_private_folder(prefixes)
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
    """The name of the planner that answers for `method`."""
    return method.planner_role if method.planner_role in RANDOM_PLANNERS else suite.planners[method.planner_role]


def check_planners(suite: Suite) -> None:
    """Check that every planner of `suite` exists and that every method has a planner, before the suite runs.

    Whether an adapter is installed is checked by `preflight.require_adapters`.

    Raises:
        UnknownNameError: a role or a planner is unknown.
        ConfigurationError: a planner is missing, cannot decode unconstrained, its name may change its meaning, or its
            address contains a user name, a password or a query other than `api-version`.
    """
    for role, planner in suite.planners.items():
        if role not in PLANNER_ROLES:
            raise UnknownNameError("planner role", role, PLANNER_ROLES, owner="a suite")
        _require_known_planner(planner)
        _require_no_secret(role, planner)
    if suite.memory.pilot and "base" not in suite.planners:
        sentence = f"Suite {suite.name} names no planner for the role base, which the pilot episodes need."
        raise ConfigurationError.stating(sentence, fix="Name one in [planners] of the suite.")
    for method in suite.resolved_methods:
        role = method.planner_role
        if role not in (*suite.planners, "adversary"):
            sentence = f"Suite {suite.name} names no planner for the role {role}, which method {method.name} needs."
            fix = (
                f"Name one with --planner {role}=adapter:ID or in [planners] of the suite, or leave out {method.name}."
            )
            raise ConfigurationError.stating(sentence, fix=fix)
        if not method.constrained and not can_be_unconstrained(planner := suite.planners[role]):
            sentence = f"Method {method.name} needs unconstrained decoding, which planner {planner} does not offer."
            raise ConfigurationError.stating(sentence, fix=f"Leave out {method.name}, or name a model that runs here.")
    if any(CHAMPION_PLANNER in underlying_planners(planner) for planner in suite.planners.values()):
        sentence = f"Suite {suite.name} names {CHAMPION_PLANNER}, which may be another adapter tomorrow."
        raise ConfigurationError.stating(sentence, fix="Name the adapter by its id: `dualbrain adapters list`.")


def underlying_planners(name: str) -> tuple[str, ...]:
    """The names of all planners that answer under `name`, without their engine: also a candidate in shadow mode."""
    return tuple(map(strip_torch_prefix, parse_shadow_name(name) if name.startswith(SHADOW_PREFIX) else (name,)))


def _require_known_planner(name: str) -> None:
    """Raise `UnknownNameError` if `name` is no planner, `ConfigurationError` for an invalid address."""
    for whole, core in zip(
        parse_shadow_name(name) if name.startswith(SHADOW_PREFIX) else (name,), underlying_planners(name), strict=True
    ):
        if core in planner_registry.planner_names() or (is_adapter(core) and core != ADAPTER_PREFIX):
            continue
        without_engine = whole == core  # an engine prefix is only for built-in models and adapters
        if without_engine and "://" in core:
            planner_registry.open_planner(core, Path()).close()  # checks the address, without a connection
        elif not (without_engine and (name in RANDOM_PLANNERS or _is_file(core))):
            known = (*RANDOM_PLANNERS, *planner_registry.planner_names(), *packaged_names(), *UNLISTED_NAME_FORMS)
            raise UnknownNameError("planner", name, known, owner="the evaluation")


def _require_no_secret(role: str, planner: str) -> None:
    """Raise `ConfigurationError` for an address that may contain a secret: results and answers record the address."""
    if has_secret_parts(planner):
        raise ConfigurationError(
            f"address of the planner for the role {role}",
            got=f"{public_planner(planner)}, with a user name, a password or a query",
            allowed="an address without them (except ?api-version=VERSION), because the results record it",
            fix="Set OPENAI_API_KEY for a key.",
        )


def _is_file(name: str) -> bool:
    """Whether `name` is that of a planner in a file."""
    return name.startswith(VALUE_PREFIX) or name.endswith(".gguf")


class PlannerFactory:
    """The planners of one suite in one process, each behind the cache of answers."""

    def __init__(self, suite: Suite, sources: PlannerSources, cache: AnswerCache) -> None:
        """Planners are opened at their first request."""
        self._suite, self._sources, self._cache = suite, sources, cache
        self._open: dict[tuple[str, str, bool], Planner] = {}
        self._caching: dict[tuple[str, str], CachingPlanner] = {}

    def get(self, method: Method, robot: str, *, constrained: bool = True) -> CachingPlanner:
        """The planner of `method` for `robot`, with constrained or unconstrained decoding, which are cached apart."""
        name, constrained = planner_name(self._suite, method), constrained and method.constrained
        parts = [name, "with a worked example" * _uses_worked_example(method, name)]
        parts += ["of fixed parameters" * (method.planner_role == FIXED_ROLE)]
        parts += [
            f"prompt {method.prompt_corruption}" * (method.prompt_corruption != "no"),
            "bound by nothing" * (not constrained),
            value_model_digest(name) if name.startswith(VALUE_PREFIX) else "",
        ]
        key = (", ".join(filter(None, parts)), robot)
        if key not in self._caching:
            self._caching[key] = CachingPlanner(
                key[0], self._cache, lambda: self._open_planner(name, robot, method, constrained)
            )
        return self._caching[key]

    def get_unconstrained(self, method: Method, robot: str) -> CachingPlanner | None:
        """The planner of `method` with unconstrained decoding, None if it has no such mode."""
        return (
            self.get(method, robot, constrained=False)
            if can_be_unconstrained(planner_name(self._suite, method))
            else None
        )

    def _open_planner(self, name: str, robot: str, method: Method, constrained: bool) -> Planner:
        if (name, robot, constrained) not in self._open:
            self._open[name, robot, constrained] = self._sources.open(name, robot, constrained=constrained)
        planner = self._open[name, robot, constrained]
        if _uses_worked_example(method, name):
            planner = FewShotPlanner(planner, BEST_FIXED if method.planner_role == FIXED_ROLE else NO_CHANGE)
        return (
            planner if method.prompt_corruption == "no" else CorruptedPromptPlanner(planner, method.prompt_corruption)
        )

    def close(self) -> None:
        """Close all open planners."""
        for planner in self._open.values():
            planner.close()
        self._open.clear()
        self._caching.clear()


def _uses_worked_example(method: Method, name: str) -> bool:
    """Whether a worked example is added: the short prompt of an adapter has none, unlike the full prompt."""
    return method.planner_role in {"prompted", FIXED_ROLE} and is_adapter(strip_torch_prefix(name))
