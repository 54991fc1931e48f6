"""Conversion of a decoding schema to an LLGuidance grammar, which llama.cpp enforces token by token.

llama.cpp's `json_schema` mode ignores numeric bounds; LLGuidance enforces them and writes compact JSON. The server
silently drops a grammar that LLGuidance cannot parse, so only keywords that are known to work are passed on. Within a
range, LLGuidance rejects numbers whose digits are a prefix of those of a bound: from 0 to 0.35 it accepts 0.29, 0.30
and 0.31, but not 0.3 (observed with 1.9.1). These numbers are added as alternatives to the range.

Where only one continuation is possible, LLGuidance by default forces its first unambiguous token: after the last word
of an action `"` instead of the token `"}` on which a model was trained. The context of the model then differs from its
training, and small models ended every contract at this point. Forcing is therefore off (`NO_FORCING`): every token that
satisfies the grammar is allowed.
"""

from __future__ import annotations

import json
from decimal import Decimal
from typing import Any

from dualbrain.contracts.schema import ORDER_KEYWORD
from dualbrain.planner.decoding.ordered_sequence import OrderedSequence

_KEYWORDS = frozenset(
    {
        "type",
        "properties",
        "required",
        "additionalProperties",
        "items",
        "minItems",
        "maxItems",
        "anyOf",
        "oneOf",
        "enum",
        "const",
        "minimum",
        "maximum",
        "pattern",
        "minLength",
        "maxLength",
        "$ref",
    }
)
_DEFINITIONS = ("$defs", "definitions")
NO_FORCING = '%llguidance {"no_forcing": true}\n'
"""First line of each grammar."""


def actions_grammar(schema: dict[str, Any]) -> str:
    """Grammar of the text after the header of a contract: its action sequence and the closing brace."""
    return _grammar(schema, "")


def tail_grammar(schema: dict[str, Any]) -> str:
    """Grammar of the text after `"action_sequence`: the closing quote, a colon, and the text of `actions_grammar`."""
    return _grammar(schema, '"\\":" ')


def contract_grammar(schema: dict[str, Any]) -> str:
    """Grammar of a whole contract, for a server that receives no beginning of the answer."""
    whole = strip_annotations(schema, prefix_items=True) | {
        key: _strip_each(schema[key]) for key in _DEFINITIONS if key in schema
    }
    return f"{NO_FORCING}start: %json {_encode_schema(whole)}"


def _grammar(schema: dict[str, Any], prefix: str) -> str:
    definitions = {key: _strip_each(schema[key]) for key in _DEFINITIONS if key in schema}
    rules = _sequence_rules("actions", schema["properties"]["action_sequence"], definitions)
    return f'{NO_FORCING}start: {prefix}actions "}}"\n{rules}'


def _sequence_rules(name: str, sequence: dict[str, Any], definitions: dict[str, Any]) -> str:
    """Rules for an action sequence called `name`; with an order of skills if `sequence` or an alternative has one."""
    alternatives = sequence.get("anyOf", ())
    if any(ORDER_KEYWORD in one for one in alternatives):
        names = [f"{name}_{number}" for number in range(len(alternatives))]
        parts = [_sequence_rules(part, one, definitions) for part, one in zip(names, alternatives, strict=True)]
        return "\n".join([f"{name}: {' | '.join(names)}", *parts])
    return _ordered_rules(name, sequence, definitions) or _json_rule(
        name, strip_annotations(sequence, prefix_items=True) | definitions
    )


def _ordered_rules(name: str, sequence: dict[str, Any], definitions: dict[str, Any]) -> str:
    """Rules for a `sequence` with an order of skills; "" without one, and if it admits no action."""
    steps = {step["properties"]["skill"]["const"]: step for step in sequence.get("items", {}).get("anyOf", ())}
    if ORDER_KEYWORD not in sequence or not steps:
        return ""
    ordered = OrderedSequence(
        name=name,
        steps={skill: f"{name}_{skill}" for skill in steps},
        order=sequence[ORDER_KEYWORD],
        least=sequence["minItems"],
        most=sequence["maxItems"],
    )
    actions = [_json_rule(ordered.steps[skill], strip_annotations(step) | definitions) for skill, step in steps.items()]
    return "\n".join([grammar, *actions]) if (grammar := ordered.grammar()) else ""


def _json_rule(name: str, schema: dict[str, Any]) -> str:
    return f"{name}: %json {_encode_schema(schema)}"


def _encode_schema(schema: dict[str, Any]) -> str:
    return json.dumps(_add_missing_numbers(schema) | {"x-guidance": {"whitespace_flexible": False}})


def _add_missing_numbers(schema: Any) -> Any:
    """`schema` with alternatives for the numbers that LLGuidance rejects between bounds."""
    if isinstance(schema, list):
        return [_add_missing_numbers(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    if schema.get("type") == "number" and (missing := _missing_numbers(schema)):
        return {"anyOf": [schema, {"enum": missing}]}
    return {key: value if key in {"enum", "const"} else _add_missing_numbers(value) for key, value in schema.items()}


def _missing_numbers(number: dict[str, Any]) -> list[float]:
    """Numbers between the bounds of `number` whose decimals are a prefix of those of a bound."""
    bounds = [Decimal(str(number[name])) for name in ("minimum", "maximum") if name in number]
    digits = (str(bound).partition(".") for bound in bounds)
    prefixes = {Decimal(f"{before}.{after[:count]}") for before, _, after in digits for count in range(1, len(after))}
    lower, upper = number.get("minimum", "-Infinity"), number.get("maximum", "Infinity")
    return [float(one) for one in sorted(prefixes) if Decimal(str(lower)) <= one <= Decimal(str(upper))]


def strip_annotations(schema: Any, *, prefix_items: bool = False) -> Any:
    """`schema` without titles, descriptions and other keywords that do not constrain the answer.

    With `prefix_items`, the schema of the first action remains; not every engine accepts it.
    """
    if not isinstance(schema, dict):
        return schema
    narrowed: dict[str, Any] = {}
    for key, value in schema.items():
        if key == "properties":
            narrowed[key] = {name: strip_annotations(one, prefix_items=prefix_items) for name, one in value.items()}
        elif key in {"anyOf", "oneOf"} or (key == "prefixItems" and prefix_items):
            narrowed[key] = [strip_annotations(item, prefix_items=prefix_items) for item in value]
        elif key in {"enum", "const"}:
            narrowed[key] = value
        elif key in _KEYWORDS:
            narrowed[key] = strip_annotations(value, prefix_items=prefix_items)
    return narrowed


def _strip_each(schemas: dict[str, Any]) -> dict[str, Any]:
    return {name: strip_annotations(schema) for name, schema in schemas.items()}
