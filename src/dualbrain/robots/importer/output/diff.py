"""What changed between two bodies, and how a person's edits survive a new making.

A body is compared entry by entry ("joints.elbow.velocity.value"); lists of named things go by their names, spheres by
link and number. Three versions matter: what was made last, what stands in the folder now (made, then edited), what is
made this time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeGuard, cast

import msgspec

from dualbrain.robots.model import RobotModel

FlatModel = dict[str, Any]


class ModelChange(NamedTuple):
    """One entry that differs; `before` or `after` is None where it is absent."""

    entry: str
    before: Any
    after: Any

    def __str__(self) -> str:
        return f"{self.entry}: {_format_value(self.before)} → {_format_value(self.after)}"


def find_changes(before: RobotModel, after: RobotModel) -> list[ModelChange]:
    """Every entry that differs."""
    a, b = flatten_model(before), flatten_model(after)
    return [ModelChange(key, a.get(key), b.get(key)) for key in dict.fromkeys([*a, *b]) if a.get(key) != b.get(key)]


def summarize_changes(changes: list[ModelChange]) -> list[str]:
    """The changes for people: limits and facts one by one, spheres and pairs counted."""
    lines = [str(change) for change in changes if not change.entry.startswith(("spheres.", "self_pairs."))]
    for part, word in (("spheres.", "sphere entries"), ("self_pairs.", "link pairs")):
        count = sum(change.entry.startswith(part) for change in changes)
        lines += [f"{count} {word} changed"] if count else []
    return lines


def reapply_edits(
    generated: RobotModel, edited: RobotModel, regenerated: RobotModel
) -> tuple[RobotModel, list[ModelChange], list[ModelChange]]:
    """`fresh` with the edits of `edited` put back; the edits kept, and those that no longer have a place.

    An edit has a place if its entry still exists and the edit did not add or remove it.
    """
    values = flatten_model(regenerated)
    kept: list[ModelChange] = []
    lost: list[ModelChange] = []
    for edit in find_changes(generated, edited):
        if edit.entry in values and edit.before is not None and edit.after is not None:
            values[edit.entry] = edit.after
            kept.append(edit)
        else:
            lost.append(edit)
    return msgspec.convert(_restore_values(msgspec.to_builtins(regenerated), values, ""), RobotModel), kept, lost


def flatten_model(robot_model: RobotModel) -> FlatModel:
    """Every leaf of `body` under its path."""
    found: FlatModel = {}
    _flatten(msgspec.to_builtins(robot_model), "", found)
    return found


def _flatten(value: Any, path: str, found: FlatModel) -> None:
    if isinstance(value, dict):
        for key, inner in cast("dict[str, Any]", value).items():
            _flatten(inner, f"{path}.{key}".lstrip("."), found)
    elif _is_list(value) and value and isinstance(value[0], dict):
        for key, inner in zip(_item_keys(value), value, strict=True):
            _flatten(inner, f"{path}.{key}", found)
    elif _is_list(value) and path.startswith("self_pairs"):
        for inner in value:
            found[f"{path}.{inner[0]}–{inner[1]}"] = inner[2] if len(inner) > 2 else "kept"
    else:
        found[path] = tuple(cast("list[Any]", value)) if isinstance(value, list) else value


def _is_list(value: Any) -> TypeGuard[Sequence[Any]]:
    return isinstance(value, (list, tuple))


def _item_keys(items: Any) -> list[str]:
    """A name for every item of a list: its own, or its link and number."""
    counts: dict[str, int] = {}
    names: list[str] = []
    for item in items:
        base = str(item.get("name") or item.get("link") or item.get("drive") or "")
        counts[base] = counts.get(base, 0) + 1
        names.append(base if "name" in item else f"{base}#{counts[base]}")
    return names


def _restore_values(value: Any, values: Mapping[str, Any], path: str) -> Any:
    """`value` with every leaf replaced by what `values` holds at its path."""
    if isinstance(value, dict):
        table = cast("dict[str, Any]", value)
        return {key: _restore_values(inner, values, f"{path}.{key}".lstrip(".")) for key, inner in table.items()}
    if _is_list(value) and value and isinstance(value[0], dict):
        return [
            _restore_values(inner, values, f"{path}.{key}") for key, inner in zip(_item_keys(value), value, strict=True)
        ]
    if _is_list(value) and path.startswith("self_pairs"):
        return value
    return values.get(path, value)


def _format_value(value: Any) -> str:
    return "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)[:120]
