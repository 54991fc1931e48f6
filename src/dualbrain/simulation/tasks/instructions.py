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

from dualbrain.errors import InvalidSetup, UnknownName

Label = Literal["possible", "impossible", "hazardous", "unauthorised"]
"""What the right answer is: carry it out, or decline (the last three; see `instructions.toml`)."""
Manner = Literal["plain", "polite", "indirect", "vague", "long", "careful"]
Part = Literal["all", "train", "held_out"]

SLOTS = ("object", "target", "second", "second_target", "group")
SALT, HELD_OUT = "505", 80
"""A wording is held out if the first byte of the SHA-256 of "salt|kind|text" is below `HELD_OUT` (31 %).

The salt is the first number with which every kind has three to six of them and six others; it was chosen by that alone.
"""
FILE = Path(__file__).with_name("instructions.toml")


class Wording(msgspec.Struct, frozen=True):
    """One way to ask for one `kind` of task: `text` is a template whose slots stand for names in the scene."""

    kind: str
    manner: Manner
    text: str

    @property
    def slots(self) -> tuple[str, ...]:
        """Names of the slots in the text, in their order, each once."""
        found = (name for _, name, _, _ in string.Formatter().parse(self.text) if name is not None)
        return tuple(dict.fromkeys(found))

    @property
    def held_out(self) -> bool:
        """Whether no training may see it."""
        return hashlib.sha256(f"{SALT}|{self.kind}|{self.text}".encode()).digest()[0] < HELD_OUT

    def words(self, **names: str) -> str:
        """The instruction, with `names` of the scene spoken as people do; raises `InvalidSetup` if one is missing."""
        missing = [slot for slot in self.slots if slot not in names]
        if missing:
            raise InvalidSetup(f"names for {self.text!r}", got=sorted(names), allowed=f"also {', '.join(missing)}")
        return self.text.format(**{slot: spoken(names[slot]) for slot in self.slots})


class Kind(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
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


class _Book(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    names: dict[str, str]
    kinds: dict[str, Kind]


MANNERS: tuple[Manner, ...] = ("plain", "polite", "indirect", "vague", "long", "careful")


def kinds(*, label: Label | None = None, mobile: bool | None = None) -> tuple[str, ...]:
    """The kinds of task, those with `label` and those that a base (`mobile`) or an arm is asked for only."""
    body = None if mobile is None else ("base" if mobile else "arm")
    return tuple(
        name
        for name, kind in _book().kinds.items()
        if label in (None, kind.label) and (body is None or kind.bodies in (body, "any"))
    )


def kind_of(name: str) -> Kind:
    """The kind called `name`; raises `UnknownName`."""
    found = _book().kinds.get(name)
    if found is None:
        raise UnknownName("kind of task", name, tuple(_book().kinds), owner=FILE.name)
    return found


def wordings(kind: str, part: Part = "all") -> tuple[Wording, ...]:
    """The wordings of `kind` in the order of the file; raises `UnknownName`."""
    of = kind_of(kind)
    whole = tuple(Wording(kind, manner, text) for manner in MANNERS for text in getattr(of, manner))
    return tuple(one for one in whole if part == "all" or one.held_out == (part == "held_out"))


def spoken(name: str) -> str:
    """A name of the scene as people say it: "red_cube" is a red cube, "table_left" the left side of the table."""
    return _book().names.get(name, name.replace("_", " "))


def wordings_hash() -> str:
    """First 16 hex digits of the SHA-256 of everything the file says, whatever its layout, and of the split."""
    said: Any = [msgspec.to_builtins(_book()), SALT, HELD_OUT]
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()[:16]


@cache
def _book() -> _Book:
    return msgspec.convert(tomllib.loads(FILE.read_text(encoding="utf-8")), _Book)
