"""How people ask: many wordings of each kind of task, and those that a robot should decline (paper 7.2).

The templates lie in `instructions.toml`. A wording is held out of training by a rule on its own text, so that adding one
moves no other, and nobody chooses: `wordings_hash` fixes the whole file before anything is trained on it.
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
"""What the right answer is: carry it out, or decline (the last three; see `instructions.toml`)."""
Manner = Literal["plain", "polite", "indirect", "vague", "long", "careful"]
Split = Literal["all", "train", "held_out"]

SLOTS = ("object", "target", "second", "second_target", "group")
SPLIT_SALT, HELD_OUT_BYTE_LIMIT = "505", 80
"""A wording is held out if the first byte of the SHA-256 of "salt|kind|text" is below `HELD_OUT` (31 %).

The salt is the first number with which every kind has three to six of them and six others; it was chosen by that alone.
"""
TEMPLATE_FILE = Path(__file__).with_name("instructions.toml")


class InstructionTemplate(msgspec.Struct, frozen=True):
    """One way to ask for one `kind` of task: `text` is a template whose slots stand for names in the scene."""

    task_kind: str
    manner: Manner
    text: str

    @property
    def slots(self) -> tuple[str, ...]:
        """Names of the slots in the text, in their order, each once."""
        found = (name for _, name, _, _ in string.Formatter().parse(self.text) if name is not None)
        return tuple(dict.fromkeys(found))

    @property
    def is_held_out(self) -> bool:
        """Whether no training may see it."""
        return hashlib.sha256(f"{SPLIT_SALT}|{self.task_kind}|{self.text}".encode()).digest()[0] < HELD_OUT_BYTE_LIMIT

    def render(self, **names: str) -> str:
        """The instruction, with `names` of the scene spoken as people do; raises `InvalidSetup` if one is missing."""
        missing = [slot for slot in self.slots if slot not in names]
        if missing:
            raise ConfigurationError(
                f"names for {self.text!r}", got=sorted(names), allowed=f"also {', '.join(missing)}"
            )
        return self.text.format(**{slot: natural_name(names[slot]) for slot in self.slots})


class TaskKind(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One kind of task: whose it is, what the right answer is, and its wordings by manner of speaking."""

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
    """The kinds of task, those with `label` and those that a base (`mobile`) or an arm is asked for only."""
    body = None if mobile is None else ("base" if mobile else "arm")
    return tuple(
        name
        for name, kind in _load_templates().kinds.items()
        if label in (None, kind.label) and (body is None or kind.bodies in (body, "any"))
    )


def find_task_kind(name: str) -> TaskKind:
    """The kind called `name`; raises `UnknownName`."""
    found = _load_templates().kinds.get(name)
    if found is None:
        raise UnknownNameError("kind of task", name, tuple(_load_templates().kinds), owner=TEMPLATE_FILE.name)
    return found


def instruction_templates(kind: str, split: Split = "all") -> tuple[InstructionTemplate, ...]:
    """The wordings of `kind` in the order of the file; raises `UnknownName`."""
    of = find_task_kind(kind)
    whole = tuple(InstructionTemplate(kind, manner, text) for manner in MANNERS for text in getattr(of, manner))
    return tuple(one for one in whole if split == "all" or one.is_held_out == (split == "held_out"))


def natural_name(name: str) -> str:
    """A name of the scene as people say it: "red_cube" is a red cube, "table_left" the left side of the table."""
    return _load_templates().names.get(name, name.replace("_", " "))


def templates_hash() -> str:
    """First 16 hex digits of the SHA-256 of everything the file says, whatever its layout, and of the split."""
    said: Any = [msgspec.to_builtins(_load_templates()), SPLIT_SALT, HELD_OUT_BYTE_LIMIT]
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()[:16]


@cache
def _load_templates() -> _TemplateFile:
    return msgspec.convert(tomllib.loads(TEMPLATE_FILE.read_text(encoding="utf-8")), _TemplateFile)
