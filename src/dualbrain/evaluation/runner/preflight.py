"""What the planners and memories of a suite need on this machine, looked for before anything is flown."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from dualbrain.adaptation.adapters.compatibility import require_fit, require_prompt
from dualbrain.adaptation.adapters.naming import folder_of, is_adapter, without_engine
from dualbrain.adaptation.adapters.registry import Adapters
from dualbrain.adaptation.adapters.stacking import layers_of, stack_of
from dualbrain.adaptation.serving.open_planner import unbinds
from dualbrain.core.weights import locate
from dualbrain.errors import MissingPart
from dualbrain.evaluation.planners.factory import Sources, asked_behind, planner_name
from dualbrain.evaluation.protocol.method import find_method
from dualbrain.evaluation.protocol.suite import Suite
from dualbrain.evaluation.results.parquet import require_tables
from dualbrain.evaluation.runner.work_units import Unit
from dualbrain.grounding.vocabulary import vocabulary
from dualbrain.memory.embedding.text_encoder import ENCODER, TOKENIZER
from dualbrain.planner.registry import planner_names


def require_adapters(suite: Suite, units: Iterable[Unit], sources: Sources) -> None:
    """Raise for the first adapter of `suite` that is not here, or was not taught a robot that one of `units` has.

    The models below need not be here. Raises `UnknownName`, `InvalidSetup`.
    """
    named = {(name, "") for name in suite.planners.values()}
    named |= {(planner_name(suite, find_method(unit.method)), unit.robot) for unit in units}
    for name, robot in sorted(named):
        for adapter in filter(is_adapter, asked_behind(name)):
            card = layers_of(folder_of(adapter, Adapters(sources.adapters), robot))[-1].card
            require_prompt(card)
            if robot:
                require_fit(card, robot, vocabulary(robot).hash)


def require_parts(suite: Suite, units: Iterable[Unit], sources: Sources) -> None:
    """Raise for the first weights or adapter that `units`, what is left of all passes, cannot do without.

    One message instead of one a unit, and at once. Raises `MissingPart`, `WrongHash`, `UnknownName`, `InvalidSetup`.
    """
    require_tables()
    left = list(units)
    asked = {(planner_name(suite, find_method(unit.method)), unit.robot) for unit in left if _asks(suite, unit)}
    for name, robot in sorted(asked):
        require_planner(name, robot, sources)
    if any(unit.stage == "start" or find_method(unit.method).remembers for unit in left):
        for name in (ENCODER, TOKENIZER):
            locate(name, sources.cache)


def _asks(suite: Suite, unit: Unit) -> bool:
    """Whether `unit` has questions that no kept answer can be counted on for."""
    method = find_method(unit.method)
    beside = method.remembers or (bool(suite.free) and unbinds(planner_name(suite, method)))
    return unit.stage in ("pilot", "plan") or (unit.stage == "fly" and beside)


def require_planner(name: str, robot: str, sources: Sources) -> None:
    """Raise if the weights or the adapter of the planner called `name` are not here; nothing is known of a server."""
    core = without_engine(name)
    if is_adapter(core):
        stack_of(folder_of(core, Adapters(sources.adapters), robot), sources.cache)
    elif core in planner_names():
        locate(core, sources.cache)
    elif core.endswith(".gguf") and "://" not in core and not Path(core).is_file():
        raise MissingPart(f"The model file of {name!r}", fix="Name a GGUF file that exists.")
