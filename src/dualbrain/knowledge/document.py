"""What is known of a document beside its text: name, version, kind, trust, origin, what was hidden in it."""

from __future__ import annotations

import re
from typing import Literal, get_args

import msgspec

from dualbrain.knowledge.readers.hidden_text import HiddenText

DocumentKind = Literal["rule", "manual", "map", "template"]
TrustLevel = Literal["site", "vendor", "unknown"]
"""site: written or approved by who runs this robot; vendor: by who made it or dualbrain; unknown: found somewhere."""

DOCUMENT_KINDS: tuple[DocumentKind, ...] = get_args(DocumentKind)
TRUST_WEIGHTS: dict[TrustLevel, float] = {"site": 1.0, "vendor": 0.9, "unknown": 0.5}
"""What each trust is worth: search scores are multiplied by it. `unknown` can be found, but is never put in a prompt,
gives no places, no regions and no templates."""


class Document(msgspec.Struct, frozen=True, rename={"robots": "bodies"}, kw_only=True):
    """One version of a document, as it was added at `added` [s, 1970 UTC] from a file called `file`.

    `bodies` are the robots it is about, none: it holds for all.
    """

    name: str
    version: str
    kind: DocumentKind
    trust: TrustLevel
    title: str
    media: str
    file: str
    added: float
    source: str
    characters: int
    chunks: int
    hidden: tuple[HiddenText, ...] = ()
    robots: tuple[str, ...] = ()


class ChunkHit(msgspec.Struct, frozen=True, rename={"bm25_score": "words"}, kw_only=True):
    """A chunk that was found: its exact `text`, the headings above it, and the parts of its score.

    `likeness` is the cosine of query and chunk (None: not looked at), `words` the BM25 score, higher is better (None:
    no word in common).
    """

    citation: Citation
    kind: DocumentKind
    trust: TrustLevel
    title: str
    path: tuple[str, ...]
    text: str
    score: float
    likeness: float | None = None
    bm25_score: float | None = None


_CITATION_PATTERN = re.compile(r"([a-z0-9][a-z0-9_-]{0,47})@([0-9a-f]{8,64})#(\d{1,9})-(\d{1,9})(?:,p(\d{1,6}))?")
SHORT_VERSION_LENGTH = 12
"""Hex digits of a version that are written out; the store completes them and refuses what is not unique."""
DOCUMENT_NAME_PATTERN = re.compile(r"[a-z0-9][a-z0-9_-]{0,47}")
"""What a document may be called: an identifier, never prose."""


class Citation(msgspec.Struct, frozen=True, kw_only=True):
    """Characters `start` to `end` of the reading of `document` in `version` (SHA-256, at least 8 hex digits).

    A reading is the text of a document as it is kept (see `reading.Reading`); offsets count its Unicode characters.
    `page` counts from 1 and is None where there are no pages. Written "panda-hand@3f2a91c0d4e7#120-480,p3".
    """

    document: str
    version: str
    start: int
    end: int
    page: int | None = None

    def __str__(self) -> str:
        where = f"{self.document}@{self.version[:SHORT_VERSION_LENGTH]}#{self.start}-{self.end}"
        return where if self.page is None else f"{where},p{self.page}"


def parse_citation(text: str) -> Citation | None:
    """The citation that `text` spells, None if it spells none."""
    found = _CITATION_PATTERN.fullmatch(text.strip())
    if found is None or int(found[3]) >= int(found[4]):
        return None
    return Citation(
        document=found[1],
        version=found[2],
        start=int(found[3]),
        end=int(found[4]),
        page=int(found[5]) if found[5] else None,
    )
