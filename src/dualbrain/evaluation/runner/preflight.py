"""What the planners and memories of a suite need on this machine, looked for before anything is flown."""

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
    """Raise for the first adapter of `suite` that is not here, or was not taught a robot that one of `units` has.

    The models below need not be here. Raises `UnknownName`, `InvalidSetup`.
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
    """Raise for the first weights or adapter that `units`, what is left of all passes, cannot do without.

    One message instead of one a unit, and at once. Raises `MissingPart`, `WrongHash`, `UnknownName`, `InvalidSetup`.
    """
    require_parquet()
    left = list(units)
    asked = {(planner_name(suite, find_method(unit.method)), unit.robot) for unit in left if _asks_planner(suite, unit)}
    for name, robot in sorted(asked):
        require_planner_files(name, robot, sources)
    if any(unit.stage == "start" or find_method(unit.method).uses_memory for unit in left):
        for name in (ENCODER_WEIGHTS, TOKENIZER_WEIGHTS):
            locate_weights(name, sources.cache)


def _asks_planner(suite: Suite, unit: WorkUnit) -> bool:
    """Whether `unit` has questions that no kept answer can be counted on for."""
    method = find_method(unit.method)
    beside = method.uses_memory or (bool(suite.free) and can_be_unconstrained(planner_name(suite, method)))
    return unit.stage in ("pilot", "plan") or (unit.stage == "fly" and beside)


def require_planner_files(name: str, robot: str, sources: PlannerSources) -> None:
    """Raise if the weights or the adapter of the planner called `name` are not here; nothing is known of a server."""
    core = strip_torch_prefix(name)
    if is_adapter(core):
        load_stack(resolve_folder(core, AdapterRegistry(sources.adapters), robot), sources.cache)
    elif core in planner_names():
        locate_weights(core, sources.cache)
    elif core.endswith(".gguf") and "://" not in core and not Path(core).is_file():
        raise MissingDependencyError(f"The model file of {name!r}", fix="Name a GGUF file that exists.")
