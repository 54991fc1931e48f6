"""The process that reads one PDF from standard input and writes its pages to standard output; started by `pdf.py`.

Left out and reported: text that is invisible by rendering mode, tiny, white, transparent, off the page, or in a layer
that is switched off. Not detectable without rendering: covered text, clipped text, and glyphs that show other letters
than they encode. Annotations, form fields and attachments are not read.
"""

from __future__ import annotations

import logging
import os
import resource
import sys
from contextlib import suppress
from io import BytesIO
from typing import Any

import msgspec

from dualbrain.knowledge.readers.hidden_text import summarize_hidden
from dualbrain.knowledge.readers.pdf import CPU_LIMIT_S, MAX_PAGES, MEMORY_LIMIT_BYTES, PdfPages
from dualbrain.knowledge.readers.pdf_visibility import VisibleTextFilter, disabled_layers
from dualbrain.knowledge.readers.reader import MAX_TEXT_CHARACTERS
from dualbrain.knowledge.rejection import DocumentRejected


def main() -> None:
    """Read one PDF, write the reply and exit."""
    reply_to = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_LIMIT_BYTES, MEMORY_LIMIT_BYTES))
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_LIMIT_S, CPU_LIMIT_S))
    logging.disable(logging.CRITICAL)
    try:
        pages = _read(sys.stdin.buffer.read())
    except (MemoryError, RecursionError) as error:
        pages = _reject("too costly", type(error).__name__, "a PDF that unpacks to less")
    except Exception as error:  # a broken file may cause any error, which is a rejection
        pages = _reject("a broken PDF", f"{type(error).__name__}: {error}"[:200], "a PDF that can be read")
    reply_to.write(msgspec.json.encode(pages))
    reply_to.flush()
    os._exit(0)


def _read(data: bytes) -> PdfPages:
    import pypdf  # noqa: PLC0415  (only this process needs it)

    reader = pypdf.PdfReader(BytesIO(data))
    if reader.is_encrypted:
        return _reject("an encrypted PDF", "a password", "no password")
    if len(reader.pages) > MAX_PAGES:
        return _reject("too large", f"{len(reader.pages)} pages", f"{MAX_PAGES} pages")
    disabled = disabled_layers(reader)
    pages: list[str] = []
    hidden: dict[str, list[str]] = {}
    for page in reader.pages:
        text_filter = VisibleTextFilter(page, disabled, hidden)
        text: Any = page.extract_text(
            visitor_operand_before=text_filter.visit_before, visitor_operand_after=text_filter.visit_after
        )
        pages.append(str(text).strip())
        if sum(map(len, pages)) > MAX_TEXT_CHARACTERS:
            return _reject("too large", f"over {MAX_TEXT_CHARACTERS} characters", f"{MAX_TEXT_CHARACTERS} characters")
    return PdfPages(
        tuple(pages), tuple(one for kind, pieces in hidden.items() for one in summarize_hidden(kind, pieces))
    )


def _reject(what: str, got: str, allowed: str) -> PdfPages:
    return PdfPages(rejection=DocumentRejected(what, got, allowed, "Print it to a new PDF, or convert it to Markdown."))


if __name__ == "__main__":
    with suppress(BrokenPipeError):
        main()
