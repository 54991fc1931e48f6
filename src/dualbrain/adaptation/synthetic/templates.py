"""Task templates: the kinds of tasks with their contracts and sentences, read from one file with a fixed hash."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Literal

import msgspec

from dualbrain.adaptation.synthetic.split import TEMPLATE_FILE_SHA256, Split
from dualbrain.errors import ChecksumError

TEMPLATE_FILE = "templates.toml"
POSSIBLE = "possible"


class TaskTemplate(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, rename={"train_sentences": "teach"}
):
    """One kind of task: its `share` of all examples, and the skeleton of the contract that answers it.

    A step of the skeleton has its skill and, by parameter, the slot of the sentence that decides it. `each` repeats the
    skeleton for every object of a group. `target` restricts the kind of the target. `train_sentences` are added to the
    instruction templates of the simulation; a kind without such templates has its own `held_out` sentences and the type
    of its `robots`. A sentence of a kind with `clause` marks a clause that no contract can express as [[KIND: words]],
    and its answer declines and quotes the clause.
    """

    share: float
    contract: tuple[dict[str, str], ...]
    target: Literal["container", "place", "any"] = "any"
    each: bool = False
    robots: str = ""
    train_sentences: tuple[str, ...] = ()
    held_out: tuple[str, ...] = ()
    clause: bool = False


class AbsentWords(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Words for objects and places that do not exist in a scene."""

    colours: tuple[str, ...]
    things: tuple[str, ...]
    places: tuple[str, ...]
    rooms: tuple[str, ...]


class TemplateBook(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The kinds of tasks by name, the reasons of declines, and by kind the share of tasks about absent objects."""

    absent: AbsentWords
    reasons: dict[str, str]
    kinds: dict[str, TaskTemplate]
    impossible: dict[str, float]


@dataclass(frozen=True)
class Phrasings:
    """How people instruct one type of robot: `sentences` and `labels` by kind, and the natural name of an object."""

    sentences: Mapping[str, tuple[str, ...]]
    labels: Mapping[str, str]
    natural_name: Callable[[str], str]


@cache
def load_templates() -> TemplateBook:
    """The content of the file; raises `ChecksumError` if the file was changed."""
    data = resources.files("dualbrain.adaptation.synthetic").joinpath(TEMPLATE_FILE).read_bytes()
    if (got := hashlib.sha256(data).hexdigest()) != TEMPLATE_FILE_SHA256:
        raise ChecksumError(TEMPLATE_FILE, got=got, expected=TEMPLATE_FILE_SHA256, path=TEMPLATE_FILE)
    return msgspec.toml.decode(data, type=TemplateBook)


def template_sentences(robots: str, split: Split, known_kinds: Collection[str]) -> dict[str, tuple[str, ...]]:
    """The sentences of the file by kind: kinds for `robots` only, and those of `known_kinds`."""
    kinds = {
        name: kind for name, kind in load_templates().kinds.items() if kind.robots == robots or name in known_kinds
    }
    return {name: kind.held_out if split == "test" else kind.train_sentences for name, kind in kinds.items()}
