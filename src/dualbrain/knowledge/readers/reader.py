"""Extraction of the text of a document from its bytes, or a rejection; nothing is executed or fetched."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import PurePath

import msgspec

from dualbrain.knowledge.readers import html, markdown, pdf
from dualbrain.knowledge.readers.hidden_text import HiddenText, blank_hidden
from dualbrain.knowledge.rejection import DocumentRejected

ExtractedText = tuple[str, tuple[int, ...], tuple[HiddenText, ...]] | DocumentRejected
"""Text, the offset of the start of each page (empty: no pages), and the hidden text."""


class DocumentText(msgspec.Struct, frozen=True, kw_only=True):
    """The stored text of a document, the offset of the start of each page, and the hidden text that was left out.

    `version` is the SHA-256 of media, text and pages, so that a citation with it refers to exactly this text. `source`
    is the SHA-256 of the original bytes. For Markdown and plain text, `text` has the length of the source and the same
    offsets, because hidden text is replaced by blanks.
    """

    media: str
    text: str
    pages: tuple[int, ...]
    hidden: tuple[HiddenText, ...]
    source: str
    version: str

    def page_at(self, offset: int) -> int | None:
        """The page, counted from 1, of the character at `offset`; None without pages."""
        return sum(start <= offset for start in self.pages) or None


def read_document(data: bytes, name: str) -> DocumentText | DocumentRejected:
    """The text of `data`, a file with the name `name` whose suffix determines the format, or a rejection.

    Raises `MissingDependencyError` if the package for the format is missing.
    """
    suffix = PurePath(name).suffix.lower()
    reader = READERS.get(suffix)
    if reader is None:
        return DocumentRejected("unknown format", suffix or "no suffix", ", ".join(READERS), "Convert it to Markdown.")
    if len(data) > MAX_FILE_BYTES:
        return DocumentRejected("too large", f"{len(data)} bytes", f"{MAX_FILE_BYTES} bytes", "Split it.")
    media, extract = reader
    extracted = extract(data)
    return extracted if isinstance(extracted, DocumentRejected) else _build_text(media, data, *extracted)


def _build_text(
    media: str, data: bytes, text: str, pages: tuple[int, ...], hidden: tuple[HiddenText, ...]
) -> DocumentText | DocumentRejected:
    if len(text) > MAX_TEXT_CHARACTERS:
        return DocumentRejected(
            "too large", f"{len(text)} characters", f"{MAX_TEXT_CHARACTERS} characters", "Split it."
        )
    visible, blanked = blank_hidden(text)
    if sum(not character.isspace() for character in visible) < MIN_VISIBLE_CHARACTERS:
        got = "no visible text" + (f"; hidden: {', '.join(one.kind for one in (*hidden, *blanked))}" if hidden else "")
        allowed, fix = f"at least {MIN_VISIBLE_CHARACTERS} visible characters", "A scan needs text recognition first."
        return DocumentRejected("nothing to read", got, allowed, fix)
    version = hashlib.sha256(msgspec.json.encode((media, visible, pages))).hexdigest()
    return DocumentText(
        media=media,
        text=visible,
        pages=pages,
        hidden=(*hidden, *blanked),
        source=hashlib.sha256(data).hexdigest(),
        version=version,
    )


def _plain(data: bytes) -> ExtractedText:
    text = decode_utf8(data)
    return text if isinstance(text, DocumentRejected) else (text, (), ())


def _markdown(data: bytes) -> ExtractedText:
    text = decode_utf8(data)
    return text if isinstance(text, DocumentRejected) else markdown.visible_text(text)


def _html(data: bytes) -> ExtractedText:
    text = decode_utf8(data)
    return text if isinstance(text, DocumentRejected) else html.visible_text(text)


def decode_utf8(data: bytes) -> str | DocumentRejected:
    """Decode strict UTF-8; a byte order mark is not part of the text."""
    try:
        text = data.removeprefix(b"\xef\xbb\xbf").decode("utf-8")
    except UnicodeDecodeError as error:
        return DocumentRejected("not UTF-8", f"byte {error.start}: {error.reason}", "UTF-8", "Save the file as UTF-8.")
    if "\0" in text:
        return DocumentRejected("not text", "a NUL byte", "text", "Is this another format under a wrong suffix?")
    return text


READERS: dict[str, tuple[str, Callable[[bytes], ExtractedText]]] = {
    ".md": ("markdown", _markdown),
    ".markdown": ("markdown", _markdown),
    ".txt": ("text", _plain),
    ".html": ("html", _html),
    ".htm": ("html", _html),
    ".pdf": ("pdf", pdf.visible_text),
    ".toml": ("toml", _plain),
    ".json": ("json", _plain),
}
"""Media type and reader of each suffix."""


MAX_FILE_BYTES = 16 * 1024 * 1024
"""Largest size of a file [bytes]."""
MAX_TEXT_CHARACTERS = 2_000_000
"""Largest length of a document text: about a thousand pages."""
MIN_VISIBLE_CHARACTERS = 20
"""A document with fewer visible characters is rejected."""
