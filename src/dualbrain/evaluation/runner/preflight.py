"""Checks before a run: what the planners and memories of a suite need on this machine must be there."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from dualbrain.adaptation.adapters.compatibility import require_compatible, require_same_prompt
from dualbrain.adaptation.adapters.naming import is_adapter, resolve_folder, strip_torch_prefix
from dualbrain.adaptation.adapters.registry import AdapterRegistry
from dualbrain.adaptation.adapters.stacking import load_stack, read_layers
from dualbrain.adaptation.serving.open_planner import can_be_unconstrained
from dualbrain.core.weights import locate_weights
from dualbrain.errors import MissingDependencyError
from dualbrain.evaluation.planners.factory import PlannerSources, planner_name, underlying_planners
from dualbrain.evaluation.protocol.method import find_method
from dualbrain.evaluation.protocol.suite import Suite
from dualbrain.evaluation.results.parquet import require_parquet
from dualbrain.evaluation.runner.work_units import WorkUnit
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.memory.embedding.text_encoder import ENCODER_WEIGHTS, TOKENIZER_WEIGHTS
from dualbrain.planner.registry import planner_names


def require_adapters(suite: Suite, units: Iterable[WorkUnit], sources: PlannerSources) -> None:
    """Raise if an adapter of `suite` is missing, or was not trained on a robot of the `units` that use it.

    The adapters' base models need not be installed.

    Raises:
        UnknownNameError: an adapter is not registered.
        ConfigurationError: an adapter was trained with another prompt or for another robot.
        MissingDependencyError: an adapter's folder does not exist.
    """
    named = {(name, "") for name in suite.planners.values()}
    named |= {(planner_name(suite, find_method(unit.method)), unit.robot) for unit in units}
    for name, robot in sorted(named):
        for adapter in filter(is_adapter, underlying_planners(name)):
            card = read_layers(resolve_folder(adapter, AdapterRegistry(sources.adapters), robot))[-1].card
            require_same_prompt(card)
            if robot:
                require_compatible(card, robot, load_skill_registry(robot).hash)


def require_dependencies(suite: Suite, units: Iterable[WorkUnit], sources: PlannerSources) -> None:
    """Raise if `units`, the remaining ones of all stages, need weights or an adapter that are not here.

    A missing part is thus reported once and at once, not by each unit.

    Raises:
        MissingDependencyError: model weights, an adapter's folder or the Parquet package are missing.
        ChecksumError: a file of weights is damaged.
        UnknownNameError: a planner or an adapter is unknown.
        ConfigurationError: an adapter does not fit its base model.
    """
    require_parquet()
    left = list(units)
    used = {(planner_name(suite, find_method(unit.method)), unit.robot) for unit in left if _asks_planner(suite, unit)}
    for name, robot in sorted(used):
        require_planner_files(name, robot, sources)
    if any(unit.stage == "start" or find_method(unit.method).uses_memory for unit in left):
        for name in (ENCODER_WEIGHTS, TOKENIZER_WEIGHTS):
            locate_weights(name, sources.cache)


def _asks_planner(suite: Suite, unit: WorkUnit) -> bool:
    """Whether `unit` may make requests whose answers are not cached."""
    method = find_method(unit.method)
    own_requests = method.uses_memory or (bool(suite.free) and can_be_unconstrained(planner_name(suite, method)))
    return unit.stage in ("pilot", "plan") or (unit.stage == "fly" and own_requests)


def require_planner_files(name: str, robot: str, sources: PlannerSources) -> None:
    """Raise if the weights or the adapter of the planner called `name` are missing; a server is not contacted.

    Raises as `require_dependencies`.
    """
    core = strip_torch_prefix(name)
    if is_adapter(core):
        load_stack(resolve_folder(core, AdapterRegistry(sources.adapters), robot), sources.cache)
    elif core in planner_names():
        locate_weights(core, sources.cache)
    elif core.endswith(".gguf") and "://" not in core and not Path(core).is_file():
        raise MissingDependencyError(f"The model file of {name!r}", fix="Name a GGUF file that exists.")
