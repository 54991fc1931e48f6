"""Stage three: does every parameter lie in its declared domain? (paper 3.3: units and parameter envelopes)."""

from __future__ import annotations

from typing import Any

from dualbrain.contracts.contract import Action, Value
from dualbrain.contracts.registry import Registry
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.skill_spec import Choice, Name, Number, Parameter, Text
from dualbrain.contracts.verdict import Rejected
from dualbrain.core.text import closest, hides_something, pointer, shown


class EnvelopeStage:
    """Bounds, words, scene names and text lengths of every registered parameter.

    A number inside its bounds but meant in another unit cannot be seen here, nor by any schema.
    """

    def __init__(self, registry: Registry) -> None:
        """Hold the parameters of `registry` by skill."""
        self._parameters = {skill.name: skill.parameters for skill in registry.skills}

    def check(self, steps: list[Any], names: SceneNames) -> tuple[Action, ...] | Rejected:
        """The actions with every number as a float, or the first value outside its domain.

        `steps` have passed the stages before: skills are registered, fields and types are right.
        """
        actions: list[Action] = []
        for index, step in enumerate(steps):
            skill, given = step["skill"], step["params"]
            params: dict[str, Value] = {}
            for parameter in self._parameters[skill]:
                value = given[parameter.name]
                if not _inside(parameter, value, names):
                    return _refusal(index, parameter, value, names)
                params[parameter.name] = float(value) if isinstance(parameter, Number) else value
            actions.append(Action(skill, params))
        return tuple(actions)


def _inside(parameter: Parameter, value: Any, names: SceneNames) -> bool:
    """Whether `value` lies in the domain of `parameter`; NaN never does."""
    if isinstance(parameter, Number):
        return parameter.lower <= value <= parameter.upper
    if isinstance(parameter, Choice):
        return value in parameter.choices
    if isinstance(parameter, Name):
        return value in names.offered(parameter.of)
    return len(value) <= parameter.max_length and not hides_something(value)


def _refusal(index: int, parameter: Parameter, value: Any, names: SceneNames) -> Rejected:
    """Where the value stands, what it is and what it may be."""
    place = pointer("action_sequence", index, "params", parameter.name)
    match parameter:
        case Number():
            low = value < parameter.lower
            bound, source = (parameter.lower, parameter.lower_from) if low else (parameter.upper, parameter.upper_from)
            hint = f"{'at least' if low else 'at most'} {bound:g} {parameter.unit} ({source})"
            allowed = {"lower": parameter.lower, "upper": parameter.upper, "unit": parameter.unit}
            return Rejected("envelope", place, shown(value), allowed, hint)
        case Choice() | Name():
            known = parameter.choices if isinstance(parameter, Choice) else names.offered(parameter.of)
            return Rejected("envelope", place, shown(value), list(known), closest(value, known))
        case Text():
            allowed = f"at most {parameter.max_length} characters, none of them hidden"
            return Rejected("envelope", place, shown(value), allowed, "write a short plain sentence")
