"""Envelope stage of the gate (paper 3.3): every parameter must be in its declared domain."""

from __future__ import annotations

from typing import Any

from dualbrain.contracts.contract import Action, ParameterValue
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.skill_spec import ChoiceParameter, NameParameter, NumberParameter, Parameter, TextParameter
from dualbrain.contracts.verdict import Rejected
from dualbrain.core.text import closest_name_hint, json_pointer, to_printable
from dualbrain.core.untrusted.hidden_characters import has_hidden_characters


class EnvelopeStage:
    """Checks bounds, choices, scene names and text lengths of all parameters.

    A number that is within its bounds but was meant in another unit cannot be detected here or by any schema.
    """

    def __init__(self, registry: SkillRegistry) -> None:
        """Use the parameters of the skills in `registry`."""
        self._parameters = {
            skill.name: tuple((p.name, isinstance(p, NumberParameter), p) for p in skill.parameters)
            for skill in registry.skills
        }

    def check(self, steps: list[Any], names: SceneNames) -> tuple[Action, ...] | Rejected:
        """The actions with every number as a float, or the rejection of the first value outside its domain.

        `steps` have passed the earlier stages: skills are registered, fields and types are right.
        """
        actions: list[Action] = []
        for index, step in enumerate(steps):
            skill, given = step["skill"], step["params"]
            params: dict[str, ParameterValue] = {}
            for name, is_number, parameter in self._parameters[skill]:
                value = given[name]
                if not _is_in_domain(parameter, value, names):
                    return _rejection(index, parameter, value, names)
                params[name] = float(value) if is_number else value
            actions.append(Action(skill, params))
        return tuple(actions)


def _is_in_domain(parameter: Parameter, value: Any, names: SceneNames) -> bool:
    """Whether `value` is in the domain of `parameter`; NaN never is."""
    if isinstance(parameter, NumberParameter):
        return parameter.lower <= value <= parameter.upper
    if isinstance(parameter, ChoiceParameter):
        return value in parameter.choices
    if isinstance(parameter, NameParameter):
        return value in names.names_of_kind(parameter.of)
    return len(value) <= parameter.max_length and not has_hidden_characters(value)


def _rejection(index: int, parameter: Parameter, value: Any, names: SceneNames) -> Rejected:
    """The rejection of `value` with its pointer and the allowed values."""
    pointer = json_pointer("action_sequence", index, "params", parameter.name)
    match parameter:
        case NumberParameter():
            low = value < parameter.lower
            bound, source = (parameter.lower, parameter.lower_from) if low else (parameter.upper, parameter.upper_from)
            hint = f"{'at least' if low else 'at most'} {bound:g} {parameter.unit} ({source})"
            allowed = {"lower": parameter.lower, "upper": parameter.upper, "unit": parameter.unit}
            return Rejected(stage="envelope", pointer=pointer, got=to_printable(value), allowed=allowed, hint=hint)
        case ChoiceParameter() | NameParameter():
            known = parameter.choices if isinstance(parameter, ChoiceParameter) else names.names_of_kind(parameter.of)
            return Rejected(
                stage="envelope",
                pointer=pointer,
                got=to_printable(value),
                allowed=list(known),
                hint=closest_name_hint(value, known),
            )
        case TextParameter():
            allowed = f"at most {parameter.max_length} characters, none of them hidden"
            return Rejected(
                stage="envelope",
                pointer=pointer,
                got=to_printable(value),
                allowed=allowed,
                hint="write a short plain sentence",
            )
