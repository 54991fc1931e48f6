"""Comparison of robot models, and preservation of a user's edits when a robot is imported again.

Models are compared entry by entry ("joints.elbow.velocity.value"): items with a name by their names, spheres by link
and number. There are three versions: the model that was generated last, the edited model in the folder, and the newly
generated model.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeGuard, cast

import msgspec

from dualbrain.robots.model import RobotModel

FlatModel = dict[str, Any]

EDIT_PROVENANCE = "edit in body.json"
"""Beginning of the provenance of an edited value beside a limit that the import has changed."""
_LINE_NUMBER = re.compile(r":[0-9]+")


class ModelChange(NamedTuple):
    """One entry that differs; `before` or `after` is None if the entry is absent."""

    entry: str
    before: Any
    after: Any

    def __str__(self) -> str:
        return f"{self.entry}: {_format_value(self.before)} → {_format_value(self.after)}"


def find_changes(before: RobotModel, after: RobotModel) -> list[ModelChange]:
    """All entries that differ between two robot models."""
    old, new = flatten_model(before), flatten_model(after)
    return [
        ModelChange(key, old.get(key), new.get(key))
        for key in dict.fromkeys([*old, *new])
        if old.get(key) != new.get(key)
    ]


def summarize_changes(changes: list[ModelChange]) -> list[str]:
    """Lines for the user: one for each change, and the number of changed sphere entries and link pairs."""
    lines = [str(change) for change in changes if not change.entry.startswith(("spheres.", "self_pairs."))]
    for prefix, name in (("spheres.", "sphere entries"), ("self_pairs.", "link pairs")):
        count = sum(change.entry.startswith(prefix) for change in changes)
        lines += [f"{count} {name} changed"] if count else []
    return lines


def reapply_edits(
    generated: RobotModel, edited: RobotModel, regenerated: RobotModel
) -> tuple[RobotModel, list[ModelChange], list[ModelChange]]:
    """`regenerated` with the user's edits (`generated` to `edited`), the edits kept, and the edits lost.

    An edit is lost if its entry no longer exists, if the edit added or removed an entry, or if it is an edit of a limit
    that the import has changed since and that is narrower now: a limit that a site states later holds.
    """
    old, new, edits = flatten_model(generated), flatten_model(regenerated), find_changes(generated, edited)
    overridden = _overridden_limits(edits, old, new)
    values, kept, lost = dict(new), list[ModelChange](), list[ModelChange]()
    for edit in edits:
        exists = edit.entry in new and edit.before is not None and edit.after is not None
        if exists and _owner(edit.entry) not in overridden:
            values[edit.entry] = edit.after
            kept.append(edit)
        else:
            lost.append(edit)
    for edit in kept:
        values |= _provenance_of_edit(edit, old, new, values)
    return msgspec.convert(_restore_values(msgspec.to_builtins(regenerated), values, ""), RobotModel), kept, lost


def _overridden_limits(edits: Sequence[ModelChange], old: FlatModel, new: FlatModel) -> set[str]:
    """The edited limits that differ between `old` and `new`, and whose edit is wider, or is not one of the value."""
    values = {edit.entry: edit.after for edit in edits}
    found: set[str] = set()
    for limit in dict.fromkeys(map(_owner, values)):
        value_entry = f"{limit}.value"
        if not (_is_limit(limit, new) and _is_changed(limit, old, new)):
            continue
        if value_entry in values:
            replaced = _is_wider(limit, values[value_entry], new[value_entry])
        else:
            replaced = old.get(value_entry) != new[value_entry]
        if replaced:
            found.add(limit)
    return found


def _provenance_of_edit(edit: ModelChange, old: FlatModel, new: FlatModel, values: FlatModel) -> FlatModel:
    """The provenance of an edited value whose limit the import has changed; none if the user states it."""
    limit, _, field = edit.entry.rpartition(".")
    entry = f"{limit}.provenance"
    if field != "value" or not _is_limit(limit, new) or not _is_changed(limit, old, new):
        return {}
    if edit.after == new[edit.entry]:
        return {}
    if values[entry] != new[entry] and not str(values[entry]).startswith(EDIT_PROVENANCE):
        return {}
    return {entry: f"{EDIT_PROVENANCE}; wider: {new[edit.entry]:g} of {new[entry]}"}


def _owner(entry: str) -> str:
    """The path of the limit of an entry: "joints.elbow.velocity" of "joints.elbow.velocity.value"."""
    return entry.rpartition(".")[0]


def _is_limit(path: str, values: FlatModel) -> bool:
    """Whether `path` is that of a limit in `values`; of a gripper only a force above 0 is one, 0 means no gripper."""
    if not {f"{path}.value", f"{path}.unit", f"{path}.provenance"} <= values.keys():
        return False
    return not path.startswith("gripper.") or (path == "gripper.force" and values[f"{path}.value"] > 0.0)


def _is_changed(limit: str, old: FlatModel, new: FlatModel) -> bool:
    """Whether value or provenance of a limit differ; the numbers of lines do not count."""
    if old.get(f"{limit}.value") != new[f"{limit}.value"]:
        return True
    before, after = (_LINE_NUMBER.sub("", str(values.get(f"{limit}.provenance"))) for values in (old, new))
    return before != after


def _is_wider(limit: str, value: float | None, stated: float) -> bool:
    """Whether an edit of a limit to `value` admits more than the `stated` one."""
    if value is None:
        return False
    return value < stated if limit.endswith(".lower") else value > stated


def flatten_model(robot_model: RobotModel) -> FlatModel:
    """Every leaf of `robot_model` under its path."""
    leaves: FlatModel = {}
    _flatten(msgspec.to_builtins(robot_model), "", leaves)
    return leaves


def _flatten(value: Any, path: str, leaves: FlatModel) -> None:
    if isinstance(value, dict):
        for key, item in cast("dict[str, Any]", value).items():
            _flatten(item, f"{path}.{key}".lstrip("."), leaves)
    elif _is_list(value) and value and isinstance(value[0], dict):
        for key, item in zip(_item_keys(value), value, strict=True):
            _flatten(item, f"{path}.{key}", leaves)
    elif _is_list(value) and path.startswith("self_pairs"):
        for pair in value:
            leaves[f"{path}.{pair[0]}–{pair[1]}"] = pair[2] if len(pair) > 2 else "kept"
    else:
        leaves[path] = tuple(cast("list[Any]", value)) if isinstance(value, list) else value


def _is_list(value: Any) -> TypeGuard[Sequence[Any]]:
    return isinstance(value, (list, tuple))


def _item_keys(items: Any) -> list[str]:
    """A key for every item of a list: its name, or its link or drive and a number."""
    counts: dict[str, int] = {}
    names: list[str] = []
    for item in items:
        base = str(item.get("name") or item.get("link") or item.get("drive") or "")
        counts[base] = counts.get(base, 0) + 1
        names.append(base if "name" in item else f"{base}#{counts[base]}")
    return names


def _restore_values(value: Any, values: Mapping[str, Any], path: str) -> Any:
    """`value` with every leaf replaced by the entry of `values` at its path."""
    if isinstance(value, dict):
        table = cast("dict[str, Any]", value)
        return {key: _restore_values(item, values, f"{path}.{key}".lstrip(".")) for key, item in table.items()}
    if _is_list(value) and value and isinstance(value[0], dict):
        return [
            _restore_values(item, values, f"{path}.{key}") for key, item in zip(_item_keys(value), value, strict=True)
        ]
    if _is_list(value) and path.startswith("self_pairs"):
        return value
    return values.get(path, value)


def _format_value(value: Any) -> str:
    return "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)[:120]
