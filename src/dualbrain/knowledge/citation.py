"""Where a quotation stands: document, version, character offsets, page; quoting it gives the same text again."""

from __future__ import annotations

import re

import msgspec

_FORM = re.compile(r"([a-z0-9][a-z0-9_-]{0,47})@([0-9a-f]{8,64})#(\d{1,9})-(\d{1,9})(?:,p(\d{1,6}))?")
SHORT = 12
"""Hex digits of a version that are written out; the store completes them and refuses what is not unique."""
DOCUMENT = re.compile(r"[a-z0-9][a-z0-9_-]{0,47}")
"""What a document may be called: an identifier, never prose."""


class Citation(msgspec.Struct, frozen=True):
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
        where = f"{self.document}@{self.version[:SHORT]}#{self.start}-{self.end}"
        return where if self.page is None else f"{where},p{self.page}"


def parse_citation(text: str) -> Citation | None:
    """The citation that `text` spells, None if it spells none."""
    found = _FORM.fullmatch(text.strip())
    if found is None or int(found[3]) >= int(found[4]):
        return None
    return Citation(found[1], found[2], int(found[3]), int(found[4]), int(found[5]) if found[5] else None)
