"""Which contract answers which kind of errand, read from one file whose hash is fixed."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Literal

import msgspec

from dualbrain.adaptation.synthetic.split import LESSONS_SHA256, Split
from dualbrain.errors import ChecksumError

TEMPLATE_FILE = "templates.toml"
POSSIBLE = "possible"


class TaskTemplate(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One kind of errand: how often it is taught (`share`), and the skeleton of the contract that answers it.

    A step of the skeleton names its skill and the parameters that the sentence decides, each with the slot that says
    it. `each` repeats the skeleton for every thing of a group. `target` says where things may go. `teach` are sentences
    beside the world's wordings; a kind that those do not have names its `robots`, and has sentences `held_out`, too.
    """

    share: float
    contract: tuple[dict[str, str], ...]
    target: Literal["container", "place", "any"] = "any"
    each: bool = False
    robots: str = ""
    teach: tuple[str, ...] = ()
    held_out: tuple[str, ...] = ()


class AbsentWords(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Words for what is not there."""

    colours: tuple[str, ...]
    things: tuple[str, ...]
    places: tuple[str, ...]
    rooms: tuple[str, ...]


class TemplateBook(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The kinds by name, what a refusal says, and of which kinds what share asks for something that is not there."""

    absent: AbsentWords
    reasons: dict[str, str]
    kinds: dict[str, TaskTemplate]
    impossible: dict[str, float]


@dataclass(frozen=True)
class Phrasings:
    """How people talk to one sort of robot: `sentences` and `labels` by kind, and how a name is `spoken`."""

    sentences: Mapping[str, tuple[str, ...]]
    labels: Mapping[str, str]
    natural_name: Callable[[str], str]


@cache
def load_templates() -> TemplateBook:
    """The file; raises `WrongHash` if it is not the one that was fixed."""
    data = resources.files("dualbrain.adaptation.synthetic").joinpath(TEMPLATE_FILE).read_bytes()
    if (got := hashlib.sha256(data).hexdigest()) != LESSONS_SHA256:
        raise ChecksumError(TEMPLATE_FILE, got=got, expected=LESSONS_SHA256, path=TEMPLATE_FILE)
    return msgspec.toml.decode(data, type=TemplateBook)


def template_sentences(robots: str, split: Split, known_kinds: Collection[str]) -> dict[str, tuple[str, ...]]:
    """The file's own sentences by kind: of kinds that only it has for `robots`, and of those `spoken_of` elsewhere."""
    kinds = {
        name: kind for name, kind in load_templates().kinds.items() if kind.robots == robots or name in known_kinds
    }
    return {name: kind.held_out if split == "test" else kind.teach for name, kind in kinds.items()}
