"""Five forms of a registry: validation, decoding and syntax schema, schemas of tools, and the text for the prompt."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Any

from dualbrain.contracts.parameter_domains import ParameterDomain, ParameterDomains
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.skill_order import SkillOrder
from dualbrain.contracts.skill_spec import (
    ChoiceParameter,
    NameParameter,
    NumberParameter,
    Parameter,
    SkillSpec,
    TextParameter,
)
from dualbrain.core.untrusted.hidden_characters import HIDDEN_CHARACTERS, every_hidden_character

MAX_ACTIONS = 8
DECLINE = "decline"
"""The skill that refuses an instruction, without any other action."""
ID_PATTERN = "^c-[0-9]{4}$"
ID_LENGTH = 6
"""Maximum length of an id; in some engines the `$` of the pattern alone would accept a trailing line feed."""

ORDER_KEYWORD = "x-order"
"""Keyword of the action sequence in a decoding schema: the automaton of a `SkillOrder`."""

DRAFT_07 = "http://json-schema.org/draft-07/schema#"
Schema = dict[str, Any]


def closed_object(properties: Schema) -> Schema:
    """Schema of an object with exactly these properties."""
    return {
        "type": "object",
        "properties": properties,
        "required": list(properties),
        "additionalProperties": False,
    }


def validation_schema(registry: SkillRegistry, names: SceneNames) -> Schema:
    """Draft-07 schema with one `enum` of skills and one `if`/`then` per skill, so that errors have an exact pointer."""
    context = {"robot": {"const": registry.robot}, "registry": {"const": registry.hash}}
    step = closed_object({"skill": {"enum": [skill.name for skill in registry.skills]}, "params": {"type": "object"}})
    step["allOf"] = [
        _skill_branch(skill, [_domain_schema(p, names) for p in skill.parameters]) for skill in registry.skills
    ]
    about = {
        "$schema": DRAFT_07,
        "title": f"Contract for {registry.robot}, registry {registry.hash}",
        "description": "Numbers are plain SI values in the unit of `x-unit`; all parameters must be given.",
    }
    return about | _contract_schema(closed_object(context), step)


def syntax_schema(registry: SkillRegistry) -> Schema:
    """Schema of the syntax stage: fields, types and array sizes, without skills, bounds, choices and scene names.

    A step with an unregistered skill is well formed if its params are numbers and strings; the authorization stage
    rejects it.
    """
    context = {"robot": {"type": "string"}, "registry": {"type": "string"}}
    scalars: Schema = {"type": "object", "additionalProperties": {"type": ["number", "string"]}}
    step = closed_object({"skill": {"type": "string"}, "params": scalars})
    step["allOf"] = [_skill_branch(skill, [_type_schema(p) for p in skill.parameters]) for skill in registry.skills]
    return {"$schema": DRAFT_07} | _contract_schema(closed_object(context), step)


def decoding_schema(
    registry: SkillRegistry,
    names: SceneNames,
    *,
    order: SkillOrder | None = None,
    domains: ParameterDomains | None = None,
    skills: Collection[str] | None = None,
    length: tuple[int, int] | None = None,
) -> Schema:
    """Schema for constrained decoders: one `anyOf` branch per skill, properties in the order of generation.

    The schema uses only keywords that LLGuidance and xgrammar enforce. A skill that needs an object or place of which
    the scene has none is left out. If every skill is left out, the schema admits no contract. Skills that `order`
    refuses first are left out of the first action (`prefixItems`); engines that enforce more read the whole order from
    the keyword `x-order`, which validators ignore. `domains` divides the parameter domains of some skills into parts;
    each part is one alternative for the parameters. With `skills` only these are admitted. `length` is the least and
    largest number of actions, except for a contract that declines.
    """
    parts = domains or {}
    steps = {
        skill.name: step
        for skill in registry.skills
        if skills is None or skill.name in skills
        if (step := _decoding_step(skill, names, parts.get(skill.name, (ParameterDomain(),))))
    }
    context = {"robot": {"const": registry.robot}, "registry": {"const": registry.hash}}
    schema = _contract_schema(closed_object(context), _any_step(list(steps.values())))
    schema["properties"]["id"] = {"type": "string", "pattern": ID_PATTERN}
    alone = steps.pop(DECLINE, None) if length is not None else None
    actions = _sequence_schema(steps, order, length or (1, MAX_ACTIONS))
    if alone is not None:
        decline = _sequence_schema({DECLINE: alone}, None, (1, 1))
        has_sequence = bool(steps) and (order is None or order.reaches(steps, length[0] if length else 1))
        actions = {"anyOf": [actions, decline]} if has_sequence else decline  # engines refuse an empty alternative
    schema["properties"]["action_sequence"] = actions
    return schema


def step_schemas(schema: Schema) -> list[Schema]:
    """The schemas of the actions that a decoding `schema` admits, one for each skill."""
    return [step for actions in _sequences(schema) for step in actions["items"].get("anyOf", ())]


def first_skills(schema: Schema) -> tuple[str, ...]:
    """The skills that a decoding `schema` admits as the first action."""
    first = [actions.get("prefixItems", [actions["items"]])[0] for actions in _sequences(schema)]
    return tuple(step["properties"]["skill"]["const"] for one in first for step in one.get("anyOf", ()))


def _sequences(schema: Schema) -> list[Schema]:
    """The alternatives for the action sequence in a decoding `schema`."""
    actions = schema["properties"]["action_sequence"]
    return list(actions.get("anyOf", [actions]))


def _sequence_schema(steps: dict[str, Schema], order: SkillOrder | None, length: tuple[int, int]) -> Schema:
    """Schema of an action sequence of `steps` (by skill) in an `order` that is admitted."""
    least, most = length
    actions: Schema = {
        "type": "array",
        "minItems": least,
        "maxItems": most,
        "items": _any_step(list(steps.values())),
    }
    if order is None:
        return actions
    actions[ORDER_KEYWORD] = order.as_json()
    first = [step for name, step in steps.items() if order.admits([name])]
    return actions if len(first) == len(steps) else actions | {"prefixItems": [_any_step(first)]}


def describe_skills(registry: SkillRegistry, names: SceneNames) -> str:
    """Prompt text: one line per skill, `grasp(object: graspable name, speed: 0.05..0.4 m/s) …`, then the names."""
    lines = [
        f"{skill.name}({', '.join(map(_describe_parameter, skill.parameters))}) {skill.description}"
        for skill in registry.skills
    ]
    lines.append(f"graspable: {', '.join(names.graspable) or 'nothing'}")
    lines.append(f"receptive: {', '.join(names.receptive) or 'nothing'}")
    return "\n".join(lines)


def tool_schemas(registry: SkillRegistry, names: SceneNames) -> list[Schema]:
    """One tool per skill, in the form of OpenAI-style function calls; its `parameters` are those of a contract's step.

    A parameter of a name of which `names` has none is any text.
    """
    return [
        {
            "type": "function",
            "function": {
                "name": skill.name,
                "description": skill.description,
                "parameters": closed_object({p.name: _tool_parameter(p, names) for p in skill.parameters}),
            },
        }
        for skill in registry.skills
    ]


# --- parts ----------------------------------------------------------------------------------------------------------


def _contract_schema(context: Schema, step: Schema) -> Schema:
    """The common part of all schemas: id, context, one to eight steps."""
    steps: Schema = {"type": "array", "minItems": 1, "maxItems": MAX_ACTIONS, "items": step}
    identity: Schema = {"type": "string", "pattern": ID_PATTERN, "maxLength": ID_LENGTH}
    return closed_object({"id": identity, "context": context, "action_sequence": steps})


def _any_step(branches: list[Schema]) -> Schema:
    """Schema of one step out of `branches`."""
    return {"anyOf": branches} if branches else {"enum": []}


def _skill_branch(skill: SkillSpec, domains: list[Schema]) -> Schema:
    """Schema clause: if the step calls `skill`, its params are exactly `domains`."""
    params = closed_object(dict(zip((p.name for p in skill.parameters), domains, strict=True)))
    calls = {"properties": {"skill": {"const": skill.name}}, "required": ["skill"]}
    return {"if": calls, "then": {"properties": {"params": params}}}


def _type_schema(parameter: Parameter) -> Schema:
    """The JSON type of a parameter, without its domain."""
    return {"type": "number" if isinstance(parameter, NumberParameter) else "string"}


def _domain_schema(parameter: Parameter, names: SceneNames) -> Schema:
    """The whole domain of a parameter, with its description."""
    match parameter:
        case NumberParameter():
            schema = _bounded_number(parameter) | {"x-unit": parameter.unit}
        case ChoiceParameter():
            schema = {"type": "string", "enum": list(parameter.choices)}
        case NameParameter():
            schema = {"type": "string", "enum": list(names.names_of_kind(parameter.of))}
        case TextParameter():
            hidden = {"pattern": f"[{every_hidden_character()}]"}
            schema = {"type": "string", "maxLength": parameter.max_length, "not": hidden}
    return schema | {"description": _description(parameter)}


def _tool_parameter(parameter: Parameter, names: SceneNames) -> Schema:
    """The domain of a parameter of a tool; an `enum` without entries would admit nothing and is no valid schema."""
    schema = _domain_schema(parameter, names)
    return {key: value for key, value in schema.items() if key != "enum" or value}


def _description(parameter: Parameter) -> str:
    """Description of a parameter; of a number also the unit and the provenance of each bound."""
    if not isinstance(parameter, NumberParameter):
        return parameter.description or parameter.name
    bounds = f"{parameter.lower:g} ({parameter.lower_from}) to {parameter.upper:g} ({parameter.upper_from})"
    return f"{parameter.description or parameter.name} [{parameter.unit}], {bounds}"


def _bounded_number(number: NumberParameter) -> Schema:
    """Schema of a number within its bounds, both included."""
    return {"type": "number", "minimum": number.lower, "maximum": number.upper}


def _decoding_step(skill: SkillSpec, names: SceneNames, parts: Sequence[ParameterDomain]) -> Schema | None:
    """One branch of the decoding schema: the name of the skill, then its params in the order of the registry.

    None if in every part of the domain a parameter has no value left.
    """
    alternatives = [{p.name: _decoding_domain_schema(p, names, part) for p in skill.parameters} for part in parts]
    params = [closed_object(domains) for domains in alternatives if all(map(_has_value, domains.values()))]
    if not params:
        return None
    return closed_object(
        {"skill": {"const": skill.name}, "params": params[0] if len(params) == 1 else {"anyOf": params}}
    )


def _decoding_domain_schema(parameter: Parameter, names: SceneNames, part: ParameterDomain) -> Schema:
    """The domain of a parameter in a part of the whole domain, in keywords that decoders enforce."""
    match parameter:
        case NumberParameter():
            return _bounded_number(parameter) | {
                "minimum": max(parameter.lower, part.least.get(parameter.name, parameter.lower)),
                "maximum": min(parameter.upper, part.most.get(parameter.name, parameter.upper)),
            }
        case ChoiceParameter():
            return {"enum": _admitted(parameter.choices, part.admitted.get(parameter.name))}
        case NameParameter():
            return {"enum": _admitted(names.names_of_kind(parameter.of), part.admitted.get(parameter.name))}
        case TextParameter():
            return {"type": "string", "pattern": f"^[^{HIDDEN_CHARACTERS}]{{0,{parameter.max_length}}}$"}


def _admitted(values: Sequence[str], admitted: Collection[str] | None) -> list[str]:
    """Those of `values` that are `admitted`; all if there is no restriction."""
    return [value for value in values if admitted is None or value in admitted]


def _has_value(domain: Schema) -> bool:
    """Whether the domain of a parameter has a value."""
    return bool(domain.get("enum", True)) and domain.get("minimum", 0.0) <= domain.get("maximum", math.inf)


def _describe_parameter(parameter: Parameter) -> str:
    """A parameter as one phrase of the prompt text."""
    match parameter:
        case NumberParameter():
            return f"{parameter.name}: {parameter.lower:g}..{parameter.upper:g} {parameter.unit}"
        case ChoiceParameter():
            return f"{parameter.name}: {'|'.join(parameter.choices)}"
        case NameParameter():
            return f"{parameter.name}: {'name' if parameter.of == 'any' else f'{parameter.of} name'}"
        case TextParameter():
            return f"{parameter.name}: text of at most {parameter.max_length} characters"
