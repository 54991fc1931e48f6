"""Metadata of a document (name, version, kind, trust, source, hidden text), search hits, and citations."""

from __future__ import annotations

import re
from typing import Literal, get_args

import msgspec

from dualbrain.knowledge.readers.hidden_text import HiddenText

DocumentKind = Literal["rule", "manual", "map", "template"]
TrustLevel = Literal["site", "vendor", "unknown"]
"""site: written or approved by the operator of this robot; vendor: by the maker of the robot or of dualbrain; unknown:
from any other source."""

ConsultedDocuments = Literal["on", "site", "off"]
"""Documents whose passages enter a prompt: those of trust `site` and `vendor`, those of trust `site`, or none."""

DOCUMENT_KINDS: tuple[DocumentKind, ...] = get_args(DocumentKind)
TRUST_WEIGHTS: dict[TrustLevel, float] = {"site": 1.0, "vendor": 0.9, "unknown": 0.5}
"""Factor of each trust level in search scores. Documents with trust `unknown` can be found, but never enter a prompt
and provide no places, regions or templates."""


class Document(msgspec.Struct, frozen=True, rename={"robots": "bodies"}, kw_only=True):
    """One version of a document, which was added at `added` [s, 1970 UTC] from a file with the name `file`.

    `robots` are the robots that the document is about; without names it is about all robots. `source` is the SHA-256 of
    the file, `hidden` lists the text that was left out.
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
    """A chunk that a search found: its exact `text`, the headings above it (`path`), and the parts of its score.

    `likeness` is the cosine of query and chunk (None: not computed), `bm25_score` the BM25 score, higher is better
    (None: no common word).
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
"""Number of hex digits of a version in a citation; the store refuses digits that match several versions."""
DOCUMENT_NAME_PATTERN = re.compile(r"[a-z0-9][a-z0-9_-]{0,47}")
"""Pattern of document names, which are identifiers."""


class Citation(msgspec.Struct, frozen=True, kw_only=True):
    """Characters `start` to `end` of the text of `document` in `version` (SHA-256, at least 8 hex digits).

    Offsets count the Unicode characters of the stored text (see `readers.reader.DocumentText`). `page` counts from 1
    and is None without pages. The text form is "panda-hand@3f2a91c0d4e7#120-480,p3".
    """

    document: str
    version: str
    start: int
    end: int
    page: int | None = None

    def __str__(self) -> str:
        text = f"{self.document}@{self.version[:SHORT_VERSION_LENGTH]}#{self.start}-{self.end}"
        return text if self.page is None else f"{text},p{self.page}"


def parse_citation(text: str) -> Citation | None:
    """The citation in the text form `text`; None if `text` is not a citation."""
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
