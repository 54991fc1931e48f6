"""Extraction of the text of a document from its bytes, or a rejection; nothing is executed or fetched."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import partial
from pathlib import PurePath

import msgspec

from dualbrain.core.untrusted.bounded_file import byte_size
from dualbrain.core.untrusted.bounded_process import ProcessFailure, ProcessLimits, run_bounded
from dualbrain.knowledge.readers.extraction import Extraction
from dualbrain.knowledge.readers.hidden_text import HiddenText, blank_hidden
from dualbrain.knowledge.readers.markdown import TextBlock
from dualbrain.knowledge.rejection import DocumentRejected

LIMITS = ProcessLimits(output_bytes=64 << 20)
"""Limits of the process that reads Markdown, HTML and PDF."""
STRUCTURED_SUFFIXES = frozenset({".toml", ".json"})
"""Suffixes of the files that can be maps or templates."""
BLOCK_MEDIA = frozenset({"markdown", "html"})
"""Media types whose texts have blocks."""


class DocumentText(msgspec.Struct, frozen=True, kw_only=True):
    """The stored text of a document, the offset of the start of each page, and the hidden text that was left out.

    `version` is the SHA-256 of media, text and pages, so that a citation with it refers to exactly this text. `source`
    is the SHA-256 of the original bytes. For Markdown and plain text, `text` has the length of the source and the same
    offsets, because hidden text is replaced by blanks. `blocks` are those of Markdown and HTML as they were read; a
    text that comes from the store has none.
    """

    media: str
    text: str
    pages: tuple[int, ...]
    hidden: tuple[HiddenText, ...]
    source: str
    version: str
    blocks: tuple[TextBlock, ...] = ()

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
    return extracted if isinstance(extracted, DocumentRejected) else _build_text(media, data, extracted)


def _build_text(media: str, data: bytes, extracted: Extraction) -> DocumentText | DocumentRejected:
    text, pages, hidden = extracted.text, extracted.pages, extracted.hidden
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
        blocks=extracted.blocks,
    )


def _plain(data: bytes) -> Extraction | DocumentRejected:
    text = decode_utf8(data)
    return text if isinstance(text, DocumentRejected) else Extraction(text=text)


def _text_in_process(function: str, data: bytes) -> Extraction | DocumentRejected:
    text = decode_utf8(data)
    return text if isinstance(text, DocumentRejected) else _in_process(function, text.encode("utf-8"))


def _in_process(function: str, data: bytes) -> Extraction | DocumentRejected:
    """The extraction by a `function` of `extraction` in a bounded process; what exceeds its limits is a rejection."""
    found = run_bounded(f"dualbrain.knowledge.readers.extraction:{function}", data, LIMITS)
    if isinstance(found, ProcessFailure):
        allowed = f"a document that is read within {LIMITS.seconds:g} s and {byte_size(LIMITS.memory_bytes)} of memory"
        what = "a broken document" if found.kind in ("signal", "exception", "start") else "too costly"
        return DocumentRejected(what, f"one that {found.reason}", allowed, "Split it, or convert it to plain text.")
    extracted = msgspec.msgpack.decode(found, type=Extraction)
    return extracted.rejection or extracted


def decode_utf8(data: bytes) -> str | DocumentRejected:
    """Decode strict UTF-8; a byte order mark is not part of the text."""
    try:
        text = data.removeprefix(b"\xef\xbb\xbf").decode("utf-8")
    except UnicodeDecodeError as error:
        return DocumentRejected("not UTF-8", f"byte {error.start}: {error.reason}", "UTF-8", "Save the file as UTF-8.")
    if "\0" in text:
        return DocumentRejected("not text", "a NUL byte", "text", "Is this another format under a wrong suffix?")
    return text


_MARKDOWN = partial(_text_in_process, "extract_markdown")
_HTML = partial(_text_in_process, "extract_html")

READERS: dict[str, tuple[str, Callable[[bytes], Extraction | DocumentRejected]]] = {
    ".md": ("markdown", _MARKDOWN),
    ".markdown": ("markdown", _MARKDOWN),
    ".txt": ("text", _plain),
    ".html": ("html", _HTML),
    ".htm": ("html", _HTML),
    ".pdf": ("pdf", partial(_in_process, "extract_pdf")),
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
