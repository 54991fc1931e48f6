"""Stage one: is it a contract at all? Fields, types and array sizes (paper 3.3)."""

from __future__ import annotations

from typing import Any, cast

import jsonschema_rs

from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.schema import MAX_ACTIONS, Schema, syntax_schema
from dualbrain.contracts.verdict import Rejected
from dualbrain.core.text import closest_name_hint, json_pointer, to_printable

_ERROR_RANK = {"type": 0, "additionalProperties": 1, "required": 2}
"""At one place a wrong type is named first, and an unknown field before a missing one: mostly one misspelt field."""


class SyntaxStage:
    """The registry's syntax schema, compiled once."""

    def __init__(self, registry: SkillRegistry) -> None:
        """Compile for `registry`."""
        self._schema = syntax_schema(registry)
        self._compiled = jsonschema_rs.Draft7Validator(self._schema)

    def check(self, document: Any) -> Rejected | None:
        """None if `document` is well formed, else what is wrong at its first wrong place."""
        if self._compiled.is_valid(document):
            return None
        refusal = _reject_too_many_actions(document)
        if refusal is not None:
            return refusal
        first = min(self._compiled.iter_errors(document), key=_error_order)
        return _rejection(first, self._schema)


def _reject_too_many_actions(document: Any) -> Rejected | None:
    """A refusal of too many actions, before all errors are gathered: those of 64 KiB would take a second."""
    steps: Any = cast("dict[str, Any]", document).get("action_sequence") if isinstance(document, dict) else None
    if isinstance(steps, list) and len(cast("list[Any]", steps)) > MAX_ACTIONS:
        return _action_count_rejection(json_pointer("action_sequence"), steps)
    return None


def _action_count_rejection(place: str, steps: Any) -> Rejected:
    """The refusal of an array of actions that is empty or too long."""
    return Rejected(
        stage="syntax",
        pointer=place,
        got=to_printable(steps),
        allowed=f"1 to {MAX_ACTIONS} actions",
        hint="plan with fewer or with some actions",
    )


def _error_order(error: jsonschema_rs.ValidationError) -> tuple[list[tuple[int, str]], int, int]:
    """Outer places before inner ones, array items by index; at one place by rank, then the narrower type."""
    place = [(part, "") if isinstance(part, int) else (-1, part) for part in error.instance_path]
    return place, _ERROR_RANK.get(error.kind.name, 1), len(error.kind.as_dict().get("types", ()))


def _rejection(error: jsonschema_rs.ValidationError, schema: Schema) -> Rejected:
    """What a person needs to mend the place that `error` names."""
    place, facts = json_pointer(*error.instance_path), error.kind.as_dict()
    match error.kind.name:
        case "type":
            wanted = " or ".join(facts["types"])
            return Rejected(
                stage="syntax",
                pointer=place,
                got=to_printable(error.instance),
                allowed=wanted,
                hint=f"write a JSON {wanted} here",
            )
        case "required":
            missing = facts["property"]
            return Rejected(
                stage="syntax", pointer=place, got=None, allowed=missing, hint=f"add the missing field {missing!r}"
            )
        case "additionalProperties":
            extra, known = min(facts["unexpected"]), _known_fields(error, schema)
            return Rejected(
                stage="syntax",
                pointer=place,
                got=to_printable(extra),
                allowed=list(known),
                hint=f"drop or rename this field; {closest_name_hint(extra, known)}",
            )
        case "minItems" | "maxItems":
            return _action_count_rejection(place, error.instance)
        case _:
            return Rejected(
                stage="syntax",
                pointer=place,
                got=to_printable(error.instance),
                allowed="'c-' and four digits",
                hint="write an id like 'c-0001'",
            )


def _known_fields(error: jsonschema_rs.ValidationError, schema: Schema) -> tuple[str, ...]:
    """The fields of the object at the error's place, read from the part of `schema` that refused it."""
    part: Any = schema
    for key in error.schema_path[:-1]:
        part = part[key]
    return tuple(part["properties"])
