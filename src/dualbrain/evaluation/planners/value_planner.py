"""The planner `value:FILE`: the choice of a value model, without a language model (method V).

It shows how much of the merit of an adapted planner is that of the value model. It reads the same text as an adapted
planner, a scene with fitting values; object and destination are those of the planner `template`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dualbrain.adaptation.value_model.symbols import Placement, stated_value
from dualbrain.adaptation.value_model.value_model import ValueModel, load_value_model
from dualbrain.core.storage.checksum import file_sha256
from dualbrain.evaluation.planners.random_contract import encode_contract, skill_parameter_schemas
from dualbrain.evaluation.planners.template import TemplatePlanner, match_name
from dualbrain.grounding.alternatives import CHANGED_LEVELS, COMMON_LEVELS, DEFAULT_ALTERNATIVE
from dualbrain.planner.protocol import STOP
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal
from dualbrain.skills.parameters import LEVELS

VALUE_PREFIX = "value:"
OTHER_AXIS = {"along": "across", "across": "along"}
STATED_WORDS = {"opening": "opening", "clearance": "clearance", "finger_axis": "free_finger_axis"}
"""The word before the value of each fitted parameter in a summary."""


def load_value_planner(name: str) -> ValuePlanner:
    """The planner `name` = value:FILE; raises `ConfigurationError` for an unreadable file."""
    return ValuePlanner(name, load_value_model(Path(name.removeprefix(VALUE_PREFIX))))


def value_model_digest(name: str) -> str:
    """The first 16 hex digits of the SHA-256 of the file of the planner `name`: cached answers are of one file."""
    path = Path(name.removeprefix(VALUE_PREFIX))
    return file_sha256(path)[:16] if path.is_file() else ""


class ValuePlanner:
    """Answers with the alternative that `model` chooses; other tasks are answered as the planner `template` does."""

    def __init__(self, name: str, model: ValueModel) -> None:
        """Choose with `model`; `name` is recorded with every proposal."""
        self.name, self._model, self._template = name, model, TemplatePlanner()

    def propose(self, request: PlanRequest) -> Proposal:
        """A contract for the placement that the instruction names."""
        known = skill_parameter_schemas(request)
        if not {"grasp", "place"} <= known.keys():
            return self._template.propose(request)
        names = (known["grasp"]["object"]["enum"], known["place"]["destination"]["enum"])
        obj, destination = (_find_name(request.instruction, some) for some in names)
        if obj is None or destination is None:
            return self._template.propose(request)
        placement = Placement(request.scene_with_values, obj, destination)
        chosen = self._model.choose(placement, list(CHANGED_LEVELS), DEFAULT_ALTERNATIVE)
        steps = (("grasp", {"object": obj}), ("place", {"destination": destination}))
        actions = [
            {"skill": skill, "params": _parameters(placement, chosen, known[skill], given)} for skill, given in steps
        ]
        return Proposal(
            text=encode_contract(request, actions), finish_reason=STOP, planner=self.name, timings={"total": 0.0}
        )

    def close(self) -> None:
        """Nothing is open."""


def _find_name(instruction: str, admitted: list[str]) -> str | None:
    """The name that the words contain, else the only one that the schema admits: that of a goal that was read."""
    return match_name(instruction, admitted) or (admitted[0] if len(admitted) == 1 else None)


def _parameters(
    placement: Placement, alternative: str, domains: dict[str, Any], given: dict[str, str]
) -> dict[str, float | str]:
    """The `given` parameters of one skill, and all others at the levels of `alternative`, within their bounds."""
    levels = {**COMMON_LEVELS, **CHANGED_LEVELS[alternative]}
    found: dict[str, float | str] = {}
    for name, domain in domains.items():
        if name in given:
            found[name] = given[name]
        elif name in levels:
            value = _value(placement, name, levels)
            found[name] = min(max(float(value), domain["minimum"]), domain["maximum"]) if "minimum" in domain else value
    return found


def _value(placement: Placement, parameter: str, levels: dict[str, str]) -> float | str:
    """The value of `parameter` at its level; a summary states the opening of the free axis only."""
    level, stated = levels[parameter], stated_value(placement, STATED_WORDS.get(parameter, ""))
    if parameter == "finger_axis":
        free = stated or "along"
        return free if level == "free" else OTHER_AXIS[free]
    if parameter == "opening" and levels["finger_axis"] == "other":
        return LEVELS["opening"]["wide"]
    if level == "fitted":
        return float(stated) if stated else LEVELS[parameter]["wide" if parameter == "opening" else "middle"]
    return LEVELS[parameter][level]
