"""Syntax stage of the gate (paper 3.3): fields, types and array sizes."""

from __future__ import annotations

from typing import Any, cast

import jsonschema_rs

from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.schema import MAX_ACTIONS, Schema, syntax_schema
from dualbrain.contracts.verdict import Rejected
from dualbrain.core.text import closest_name_hint, json_pointer, to_printable

_ERROR_RANK = {"type": 0, "additionalProperties": 1, "required": 2}
"""Order of the errors at one place: a wrong type, then an unknown field, then a missing field.

An unknown and a missing field together are mostly one misspelt field."""


class SyntaxStage:
    """Checks documents against the syntax schema of a registry, which is compiled once."""

    def __init__(self, registry: SkillRegistry) -> None:
        """Compile the syntax schema of `registry`."""
        self._schema = syntax_schema(registry)
        self._compiled = jsonschema_rs.Draft7Validator(self._schema)
        self._compiled_action = jsonschema_rs.Draft7Validator(self._schema["properties"]["action_sequence"]["items"])

    def check(self, document: Any) -> Rejected | None:
        """None if `document` is well formed, else the rejection of its first wrong place."""
        if self._compiled.is_valid(document):
            return None
        rejection = _reject_too_many_actions(document)
        if rejection is not None:
            return rejection
        first = min(self._compiled.iter_errors(self._first_wrong_part(document)), key=_error_order)
        return _rejection(first, self._schema)

    def _first_wrong_part(self, document: Any) -> Any:
        """The part of `document` that contains its first wrong place: no actions after the first wrong one.

        All errors of the part are collected. Their number, and with it the time, must not grow with the document.
        """
        actions = _action_list(document)
        first = next(
            (k for k, action in enumerate(actions) if not self._compiled_action.is_valid(action)), len(actions)
        )
        return {**document, "action_sequence": actions[: first + 1]} if actions else document


def _action_list(document: Any) -> list[Any]:
    """The array of actions in `document`, empty if there is none."""
    steps: Any = cast("dict[str, Any]", document).get("action_sequence") if isinstance(document, dict) else None
    return cast("list[Any]", steps) if isinstance(steps, list) else []


def _reject_too_many_actions(document: Any) -> Rejected | None:
    """The rejection of too many actions, found before all errors are collected, which takes a second for 64 KiB."""
    actions = _action_list(document)
    if len(actions) > MAX_ACTIONS:
        return _action_count_rejection(json_pointer("action_sequence"), actions)
    return None


def _action_count_rejection(pointer: str, steps: Any) -> Rejected:
    """The rejection of an array of actions that is empty or too long."""
    return Rejected(
        stage="syntax",
        pointer=pointer,
        got=to_printable(steps),
        allowed=f"1 to {MAX_ACTIONS} actions",
        hint="plan with fewer or with some actions",
    )


def _error_order(error: jsonschema_rs.ValidationError) -> tuple[list[tuple[int, str]], int, int]:
    """Sort key: outer places before inner ones, array items by index, then by rank, then the narrower type."""
    path = [(part, "") if isinstance(part, int) else (-1, part) for part in error.instance_path]
    return path, _ERROR_RANK.get(error.kind.name, 1), len(error.kind.as_dict().get("types", ()))


def _rejection(error: jsonschema_rs.ValidationError, schema: Schema) -> Rejected:
    """The rejection that describes the schema violation `error`."""
    pointer, details = json_pointer(*error.instance_path), error.kind.as_dict()
    match error.kind.name:
        case "type":
            types = " or ".join(details["types"])
            return Rejected(
                stage="syntax",
                pointer=pointer,
                got=to_printable(error.instance),
                allowed=types,
                hint=f"write a JSON {types} here",
            )
        case "required":
            missing = details["property"]
            return Rejected(
                stage="syntax", pointer=pointer, got=None, allowed=missing, hint=f"add the missing field {missing!r}"
            )
        case "additionalProperties":
            extra, known = min(details["unexpected"]), _known_fields(error, schema)
            return Rejected(
                stage="syntax",
                pointer=pointer,
                got=to_printable(extra),
                allowed=list(known),
                hint=f"drop or rename this field; {closest_name_hint(extra, known)}",
            )
        case "minItems" | "maxItems":
            return _action_count_rejection(pointer, error.instance)
        case _:
            return Rejected(
                stage="syntax",
                pointer=pointer,
                got=to_printable(error.instance),
                allowed="'c-' and four digits",
                hint="write an id like 'c-0001'",
            )


def _known_fields(error: jsonschema_rs.ValidationError, schema: Schema) -> tuple[str, ...]:
    """The fields of the object at the place of `error`, read from the part of `schema` that it violates."""
    part: Any = schema
    for key in error.schema_path[:-1]:
        part = part[key]
    return tuple(part["properties"])
