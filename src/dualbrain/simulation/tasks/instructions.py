"""Instruction templates for each kind of task, including requests that a robot should decline (paper 7.2).

The templates are in `instructions.toml`. A rule on the text of a template decides whether it is held out of training,
so that a new template does not change the split of the others; `templates_hash` identifies the file and the split.
"""

from __future__ import annotations

import hashlib
import json
import string
import tomllib
from functools import cache
from pathlib import Path
from typing import Any, Literal

import msgspec

from dualbrain.errors import ConfigurationError, UnknownNameError

Label = Literal["possible", "impossible", "hazardous", "unauthorised"]
"""The right response to an instruction: execute it ("possible"), or decline it (see `instructions.toml`)."""
Manner = Literal["plain", "polite", "indirect", "vague", "long", "careful"]
Split = Literal["all", "train", "held_out"]

SLOTS = ("object", "target", "second", "second_target", "group")
SPLIT_SALT, HELD_OUT_BYTE_LIMIT = "505", 80
"""A template is held out if the first byte of the SHA-256 of "salt|kind|text" is below `HELD_OUT_BYTE_LIMIT` (31 %).

The salt is the smallest number for which every kind has three to six held-out templates and at least six others.
"""
TEMPLATE_FILE = Path(__file__).with_name("instructions.toml")


class InstructionTemplate(msgspec.Struct, frozen=True):
    """One instruction for one kind of task: `text` is a template whose slots are filled with names in the scene."""

    task_kind: str
    manner: Manner
    text: str

    @property
    def slots(self) -> tuple[str, ...]:
        """Names of the slots in the text, in order of first use, each once."""
        found = (name for _, name, _, _ in string.Formatter().parse(self.text) if name is not None)
        return tuple(dict.fromkeys(found))

    @property
    def is_held_out(self) -> bool:
        """Whether the template must not be used for training."""
        return hashlib.sha256(f"{SPLIT_SALT}|{self.task_kind}|{self.text}".encode()).digest()[0] < HELD_OUT_BYTE_LIMIT

    def render(self, **names: str) -> str:
        """The instruction with `names` in natural language; raises `ConfigurationError` if a slot has no name."""
        missing = [slot for slot in self.slots if slot not in names]
        if missing:
            allowed = f"a name for each of the slots {', '.join(self.slots)}"
            raise ConfigurationError(f"names for {self.text!r}", got=sorted(names), allowed=allowed)
        return self.text.format(**{slot: natural_name(names[slot]) for slot in self.slots})


class TaskKind(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One kind of task: the robots it suits (`bodies`), the right response (`label`), and its templates by manner."""

    bodies: Literal["arm", "base", "any"]
    label: Label
    about: str
    plain: tuple[str, ...] = ()
    polite: tuple[str, ...] = ()
    indirect: tuple[str, ...] = ()
    vague: tuple[str, ...] = ()
    long: tuple[str, ...] = ()
    careful: tuple[str, ...] = ()


class _TemplateFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    names: dict[str, str]
    kinds: dict[str, TaskKind]


MANNERS: tuple[Manner, ...] = ("plain", "polite", "indirect", "vague", "long", "careful")


def task_kinds(*, label: Label | None = None, mobile: bool | None = None) -> tuple[str, ...]:
    """The names of the kinds of task, optionally only those with `label`, or for a base (`mobile`) or an arm."""
    robot_type = None if mobile is None else ("base" if mobile else "arm")
    return tuple(
        name
        for name, kind in _load_templates().kinds.items()
        if label in (None, kind.label) and (robot_type is None or kind.bodies in (robot_type, "any"))
    )


def find_task_kind(name: str) -> TaskKind:
    """The kind of task called `name`; raises `UnknownNameError`."""
    found = _load_templates().kinds.get(name)
    if found is None:
        raise UnknownNameError("kind of task", name, tuple(_load_templates().kinds), owner=TEMPLATE_FILE.name)
    return found


def instruction_templates(kind: str, split: Split = "all") -> tuple[InstructionTemplate, ...]:
    """The templates for `kind`, ordered by manner and as in the file; raises `UnknownNameError`."""
    found = find_task_kind(kind)
    templates = (InstructionTemplate(kind, manner, text) for manner in MANNERS for text in getattr(found, manner))
    return tuple(one for one in templates if split == "all" or one.is_held_out == (split == "held_out"))


def natural_name(name: str) -> str:
    """A name of the scene in natural language: "red cube" for "red_cube", "left side of the table" for "table_left"."""
    return _load_templates().names.get(name, name.replace("_", " "))


def templates_hash() -> str:
    """First 16 hex digits of the SHA-256 of the content of the file, independent of its layout, and of the split."""
    content: Any = [msgspec.to_builtins(_load_templates()), SPLIT_SALT, HELD_OUT_BYTE_LIMIT]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


@cache
def _load_templates() -> _TemplateFile:
    return msgspec.convert(tomllib.loads(TEMPLATE_FILE.read_text(encoding="utf-8")), _TemplateFile)
