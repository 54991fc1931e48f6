"""From a decoding schema to an LLGuidance grammar, the constraint that llama.cpp enforces token by token.

llama.cpp's own `json_schema` mode ignores numeric bounds; LLGuidance enforces them and writes compact JSON. A grammar
that LLGuidance cannot read is dropped by the server without a word, so only keywords known to work are passed on.
"""

from __future__ import annotations

import json
from typing import Any

_KEYWORDS = frozenset({
    "type", "properties", "required", "additionalProperties", "items", "minItems", "maxItems", "anyOf", "oneOf",
    "enum", "const", "minimum", "maximum", "pattern", "minLength", "maxLength", "$ref",
})  # fmt: skip
_DEFINITIONS = ("$defs", "definitions")


def actions_grammar(schema: dict[str, Any]) -> str:
    """Grammar of what follows the header of a contract: its action sequence and the closing brace."""
    return _grammar(schema, "")


def tail_grammar(schema: dict[str, Any]) -> str:
    """Grammar of what follows the word `"action_sequence`: the closing quote, a colon, and as above."""
    return _grammar(schema, '"\\":" ')


def contract_grammar(schema: dict[str, Any]) -> str:
    """Grammar of a whole contract, for a server that is given no beginning."""
    whole = narrow(schema) | {key: _each(schema[key]) for key in _DEFINITIONS if key in schema}
    return f"%llguidance {{}}\nstart: %json {json.dumps(whole | {'x-guidance': {'whitespace_flexible': False}})}"


def _grammar(schema: dict[str, Any], before: str) -> str:
    actions = narrow(schema["properties"]["action_sequence"])
    actions |= {key: _each(schema[key]) for key in _DEFINITIONS if key in schema}
    actions["x-guidance"] = {"whitespace_flexible": False}
    return f'%llguidance {{}}\nstart: {before}actions "}}"\nactions: %json {json.dumps(actions)}'


def narrow(schema: Any) -> Any:
    """`schema` without titles, descriptions and other keywords that only people read."""
    if not isinstance(schema, dict):
        return schema
    narrowed: dict[str, Any] = {}
    for key, value in schema.items():
        if key == "properties":
            narrowed[key] = _each(value)
        elif key in {"anyOf", "oneOf"}:
            narrowed[key] = [narrow(item) for item in value]
        elif key in {"enum", "const"}:
            narrowed[key] = value
        elif key in _KEYWORDS:
            narrowed[key] = narrow(value)
    return narrowed


def _each(schemas: dict[str, Any]) -> dict[str, Any]:
    return {name: narrow(schema) for name, schema in schemas.items()}
