"""Loads the instruction sets `free*.toml` and `clauses*.toml`, and checks them against their scenes.

The rules of judgement are at the head of each file.
"""

from __future__ import annotations

import hashlib
import tomllib
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeVar

import msgspec

from dualbrain.errors import DECODE_ERRORS, ConfigurationError
from dualbrain.simulation.scenes.generators.catalogue import open_scene

PredicateKind = Literal[
    "in", "at", "held", "above", "toward", "shifted", "beside", "home", "still", "near", "turned", "unmoved"
]
"""Kinds of predicates on the final state."""
Direction = Literal["far", "near", "left", "right"]
"""Directions of the robot: far is +x, left is +y."""
REQUIRED_FIELDS: dict[PredicateKind, tuple[str, ...]] = {
    "in": ("object", "at"),
    "at": ("object", "at"),
    "held": ("object",),
    "above": ("at",),
    "toward": ("object", "at", "least"),
    "shifted": ("object", "direction", "least"),
    "beside": ("object", "at", "side", "within"),
    "home": (),
    "still": (),
    "near": ("at",),
    "turned": ("angle",),
    "unmoved": ("object",),
}
"""The fields that each kind of predicate needs; `any_of` with `count` may replace `object`."""
FREE_FILES = {
    "fourth": "free_fourth.toml",
    "third": "free_third.toml",
    "second": "free_second.toml",
    "first": "free.toml",
}
"""The files of the sets of free instructions, by the name of the set; the identifiers of one set are in no other."""
CLAUSE_FILES = {
    "first": "clauses/first.toml",
    "second": "clauses/second.toml",
    "third": "clauses/third.toml",
    "fourth": "clauses/fourth.toml",
    "fifth": "clauses/fifth.toml",
}
"""The files of the sets of instructions with and without clauses, by the name of the set."""


class Predicate(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, rename={"kind": "is"}):
    """A condition on the final state of the simulator; `least` and `within` in metres, `angle` in degrees."""

    kind: PredicateKind
    object: str = ""
    any_of: tuple[str, ...] = ()
    count: int = 0
    at: str = ""
    least: float = 0.0
    within: float = 0.0
    direction: Direction | Literal[""] = ""
    side: Direction | Literal[""] = ""
    angle: float = 0.0

    @property
    def objects(self) -> tuple[str, ...]:
        """The objects that the predicate permits to move."""
        return self.any_of or ((self.object,) if self.object else ())


class FreeInstruction(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One free instruction: its scene, and the ends that count as right.

    Without `done` only a decline is right, without `decline` only a final state that fulfils `done` or `or_done`.
    """

    id: str
    text: str
    robot: str
    scene: str
    kind: str
    done: tuple[Predicate, ...] = ()
    or_done: tuple[Predicate, ...] = ()
    decline: tuple[str, ...] = ()
    clause: tuple[str, ...] = ()
    hostile: bool = False


class ClauseInstruction(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One instruction with a clause that contracts cannot express; a refusal must contain one of `names`."""

    kind: str
    text: str
    robot: str
    scene: str
    names: tuple[str, ...]


class PlainInstruction(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One instruction without such a clause; `meaning` states its goal in the names of the scene."""

    kind: str
    text: str
    robot: str
    scene: str
    meaning: str = ""


class FreeInstructions(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One of the files of `FREE_FILES`: phrases by class of reason, and the instructions."""

    reasons: dict[str, tuple[str, ...]]
    instruction: tuple[FreeInstruction, ...]


class ClauseInstructions(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One of the files of `CLAUSE_FILES`."""

    clause: tuple[ClauseInstruction, ...]
    plain: tuple[PlainInstruction, ...]


InstructionFile = TypeVar("InstructionFile", FreeInstructions, ClauseInstructions)


@cache
def free_instructions(collection: str) -> FreeInstructions:
    """The set of `FREE_FILES` with the name `collection`; raises `ConfigurationError` for an invalid file."""
    return parse_free_instructions(_read(FREE_FILES[collection]))


@cache
def clause_instructions(collection: str) -> ClauseInstructions:
    """The set of `CLAUSE_FILES` with the name `collection`; raises `ConfigurationError` for an invalid file."""
    return _convert(_read(CLAUSE_FILES[collection]), ClauseInstructions)


def parse_free_instructions(text: str) -> FreeInstructions:
    """The instructions in `text`; raises `ConfigurationError` for a wrong field, reason or predicate."""
    found = _convert(text, FreeInstructions)
    for one in found.instruction:
        _check_instruction(one, found.reasons)
    return found


def check_names(one: FreeInstruction) -> None:
    """Raise `ConfigurationError` if a predicate of `one` names an object or place that its scene lacks."""
    spec = open_scene(one.scene, one.robot)
    objects = {obj.name for obj in spec.objects}
    known = objects | {place.name for place in spec.places}
    for predicate in (*one.done, *one.or_done):
        named = {*predicate.objects, *([predicate.at] if predicate.at else [])}
        if missing := sorted(named - known):
            raise ConfigurationError(f"names in instruction {one.id}", got=missing, allowed=", ".join(sorted(known)))


def content_hash(name: str) -> str:
    """First 16 hex digits of the SHA-256 of an instruction file; each row of a result names the file that it used."""
    return hashlib.sha256(_read(name).encode()).hexdigest()[:16]


def _check_instruction(one: FreeInstruction, reasons: dict[str, tuple[str, ...]]) -> None:
    if unknown := sorted(set(one.decline) - set(reasons)):
        raise ConfigurationError(f"decline of instruction {one.id}", got=unknown, allowed=", ".join(reasons))
    if not one.done and not one.decline:
        raise ConfigurationError(f"instruction {one.id}", got="neither done nor decline", allowed="at least one")
    for predicate in (*one.done, *one.or_done):
        missing = [name for name in REQUIRED_FIELDS[predicate.kind] if not _has_field(predicate, name)]
        if missing or bool(predicate.any_of) != bool(predicate.count):
            fields = ", ".join(REQUIRED_FIELDS[predicate.kind])
            got = f"no {', '.join(missing) or 'any_of with count'}"
            raise ConfigurationError(f"predicate {predicate.kind!r} of instruction {one.id}", got=got, allowed=fields)


def _has_field(predicate: Predicate, name: str) -> bool:
    return bool(predicate.objects) if name == "object" else bool(getattr(predicate, name))


def _read(name: str) -> str:
    return (Path(__file__).parent / name).read_text("utf-8")


def _convert(text: str, kind: type[InstructionFile]) -> InstructionFile:
    try:
        content: Any = tomllib.loads(text)
        return msgspec.convert(content, kind)
    except (tomllib.TOMLDecodeError, *DECODE_ERRORS) as error:
        raise ConfigurationError.stating(
            f"The instruction file is invalid: {error}.", fix="Correct the file."
        ) from error
