"""From a decoding schema to an LLGuidance grammar, the constraint that llama.cpp enforces token by token.

llama.cpp's own `json_schema` mode ignores numeric bounds; LLGuidance enforces them and writes compact JSON. A grammar
that LLGuidance cannot read is dropped by the server without a word, so only keywords known to work are passed on.
Between bounds it forgets numbers whose digits begin those of a bound: from 0 to 0.35 it admits 0.29, 0.30 and 0.31, but
not 0.3 (seen with 1.9.1). Those are named beside the range.

And where only one text can follow, it admits the one token of that text which no later one could change: after the
last word of an action `"`, not the `"}` in which a model was taught to write it. What the model then reads is not what
it knows, and small ones ended every contract there. So nothing is forced (`FREELY`): every token that keeps to the
grammar may come.
"""

from __future__ import annotations

import json
from decimal import Decimal
from typing import Any

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
"""How each grammar begins."""


def actions_grammar(schema: dict[str, Any]) -> str:
    """Grammar of what follows the header of a contract: its action sequence and the closing brace."""
    return _grammar(schema, "")


def tail_grammar(schema: dict[str, Any]) -> str:
    """Grammar of what follows the word `"action_sequence`: the closing quote, a colon, and as above."""
    return _grammar(schema, '"\\":" ')


def contract_grammar(schema: dict[str, Any]) -> str:
    """Grammar of a whole contract, for a server that is given no beginning."""
    whole = strip_annotations(schema) | {key: _strip_each(schema[key]) for key in _DEFINITIONS if key in schema}
    return f"{NO_FORCING}start: %json {_encode_schema(whole)}"


def _grammar(schema: dict[str, Any], before: str) -> str:
    actions = strip_annotations(schema["properties"]["action_sequence"])
    actions |= {key: _strip_each(schema[key]) for key in _DEFINITIONS if key in schema}
    return f'{NO_FORCING}start: {before}actions "}}"\nactions: %json {_encode_schema(actions)}'


def _encode_schema(narrowed: dict[str, Any]) -> str:
    return json.dumps(_add_missing_numbers(narrowed) | {"x-guidance": {"whitespace_flexible": False}})


def _add_missing_numbers(narrowed: Any) -> Any:
    """The schema with the numbers named that LLGuidance forgets between bounds."""
    if isinstance(narrowed, list):
        return [_add_missing_numbers(item) for item in narrowed]
    if not isinstance(narrowed, dict):
        return narrowed
    if narrowed.get("type") == "number" and (forgotten := _missing_numbers(narrowed)):
        return {"anyOf": [narrowed, {"enum": forgotten}]}
    return {key: value if key in {"enum", "const"} else _add_missing_numbers(value) for key, value in narrowed.items()}


def _missing_numbers(number: dict[str, Any]) -> list[float]:
    """Numbers between the bounds of `number` whose decimals are the first ones of a bound."""
    bounds = [Decimal(str(number[name])) for name in ("minimum", "maximum") if name in number]
    digits = (str(bound).partition(".") for bound in bounds)
    cut = {Decimal(f"{before}.{after[:count]}") for before, _, after in digits for count in range(1, len(after))}
    lower, upper = number.get("minimum", "-Infinity"), number.get("maximum", "Infinity")
    return [float(one) for one in sorted(cut) if Decimal(str(lower)) <= one <= Decimal(str(upper))]


def strip_annotations(schema: Any) -> Any:
    """`schema` without titles, descriptions and other keywords that only people read."""
    if not isinstance(schema, dict):
        return schema
    narrowed: dict[str, Any] = {}
    for key, value in schema.items():
        if key == "properties":
            narrowed[key] = _strip_each(value)
        elif key in {"anyOf", "oneOf"}:
            narrowed[key] = [strip_annotations(item) for item in value]
        elif key in {"enum", "const"}:
            narrowed[key] = value
        elif key in _KEYWORDS:
            narrowed[key] = strip_annotations(value)
    return narrowed


def _strip_each(schemas: dict[str, Any]) -> dict[str, Any]:
    return {name: strip_annotations(schema) for name, schema in schemas.items()}
