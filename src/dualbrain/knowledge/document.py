"""What is known of a document beside its text: name, version, kind, trust, origin, what was hidden in it."""

from __future__ import annotations

from typing import Literal, get_args

import msgspec

from dualbrain.knowledge.citation import Citation
from dualbrain.knowledge.hidden import Hidden

Kind = Literal["rule", "manual", "map", "template"]
Trust = Literal["site", "vendor", "unknown"]
"""site: written or approved by who runs this robot; vendor: by who made it or dualbrain; unknown: found somewhere."""

KINDS: tuple[Kind, ...] = get_args(Kind)
TRUST: dict[Trust, float] = {"site": 1.0, "vendor": 0.9, "unknown": 0.5}
"""What each trust is worth: search scores are multiplied by it. `unknown` can be found, but is never put in a prompt,
gives no places, no regions and no templates."""


class Document(msgspec.Struct, frozen=True):
    """One version of a document, as it was added at `added` [s, 1970 UTC] from a file called `file`.

    `bodies` are the robots it is about, none: it holds for all.
    """

    name: str
    version: str
    kind: Kind
    trust: Trust
    title: str
    media: str
    file: str
    added: float
    source: str
    characters: int
    chunks: int
    hidden: tuple[Hidden, ...] = ()
    bodies: tuple[str, ...] = ()


class Hit(msgspec.Struct, frozen=True):
    """A chunk that was found: its exact `text`, the headings above it, and the parts of its score.

    `likeness` is the cosine of query and chunk (None: not looked at), `words` the BM25 score, higher is better (None:
    no word in common).
    """

    citation: Citation
    kind: Kind
    trust: Trust
    title: str
    path: tuple[str, ...]
    text: str
    score: float
    likeness: float | None = None
    words: float | None = None
