"""Reader of PDF: the visible text of each page; runs in a bounded process, because a PDF may be malicious.

Left out and reported: text that is invisible by rendering mode, of no width, tiny, white, transparent, off the page, or
in a layer that is switched off. Not detectable without rendering: covered text, clipped text, and glyphs that show
other letters than they encode. Annotations, form fields and attachments are not read.
"""

from __future__ import annotations

from importlib import import_module
from io import BytesIO
from typing import Any

from dualbrain.errors import MissingDependencyError
from dualbrain.knowledge.readers.hidden_text import HiddenText, summarize_hidden
from dualbrain.knowledge.readers.pdf_visibility import VisibleTextFilter, disabled_layers
from dualbrain.knowledge.rejection import DocumentRejected

MAX_PAGES = 1000
MAX_PDF_CHARACTERS = 2_000_000
PAGE_SEPARATOR = "\n\n"
"""Separator between two pages in a document text."""


def visible_text(data: bytes) -> tuple[str, tuple[int, ...], tuple[HiddenText, ...]] | DocumentRejected:
    """The text of all pages, the offset of each page, and the hidden text.

    Raises `MissingDependencyError` without pypdf.
    """
    try:
        pypdf = import_module("pypdf")
    except ImportError as error:
        fix = "Install it with `pip install 'dualbrain[knowledge]'`."
        raise MissingDependencyError("The package pypdf", fix=fix) from error
    if not data.lstrip()[:5].startswith(b"%PDF-"):
        return DocumentRejected("not a PDF", ascii(data[:8])[2:-1], "a file that begins with %PDF-")
    try:
        return _read_pages(pypdf.PdfReader(BytesIO(data)))
    except (MemoryError, RecursionError):
        raise  # the limits of the process
    except Exception as error:  # a broken file may cause any error, which is a rejection
        return _reject("a broken PDF", f"{type(error).__name__}: {error}"[:200], "a PDF that can be read")


def _read_pages(reader: Any) -> tuple[str, tuple[int, ...], tuple[HiddenText, ...]] | DocumentRejected:
    if reader.is_encrypted:
        return _reject("an encrypted PDF", "a password", "no password")
    if len(reader.pages) > MAX_PAGES:
        return _reject("too large", f"{len(reader.pages)} pages", f"{MAX_PAGES} pages")
    disabled = disabled_layers(reader)
    pages: list[str] = []
    starts: list[int] = []
    length = 0
    hidden: dict[str, list[str]] = {}
    for page in reader.pages:
        text_filter = VisibleTextFilter(page, disabled, hidden)
        text: Any = page.extract_text(
            visitor_operand_before=text_filter.visit_before, visitor_operand_after=text_filter.visit_after
        )
        pages.append(str(text).strip())
        starts.append(length)
        length += len(pages[-1]) + len(PAGE_SEPARATOR)
        if length > MAX_PDF_CHARACTERS:
            return _reject("too large", f"over {MAX_PDF_CHARACTERS} characters", f"{MAX_PDF_CHARACTERS} characters")
    summary = tuple(one for kind, pieces in hidden.items() for one in summarize_hidden(kind, pieces))
    return PAGE_SEPARATOR.join(pages), tuple(starts), summary


def _reject(what: str, got: str, allowed: str) -> DocumentRejected:
    return DocumentRejected(what, got, allowed, "Print it to a new PDF, or convert it to Markdown.")
