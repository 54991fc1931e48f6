"""The process that reads one PDF from standard input and writes its pages to standard output; started by `pdf.py`.

Left out and told: text that is invisible by rendering mode, tiny, white, transparent, off the page, or in a layer that
is switched off. Not detectable without rendering: text under other things, clipped text, glyphs that show other letters
than they encode. Annotations, forms and attachments are not read.
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

from dualbrain.knowledge.readers.hidden_text import noted
from dualbrain.knowledge.readers.pdf import CPU_S, MEMORY, MOST_PAGES, Pages
from dualbrain.knowledge.readers.pdf_visibility import Ink, layers_off
from dualbrain.knowledge.readers.reader import LARGEST_READING
from dualbrain.knowledge.rejection import Refused


def main() -> None:
    """Read, answer, leave."""
    answer_to = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S))
    logging.disable(logging.CRITICAL)
    try:
        found = _read(sys.stdin.buffer.read())
    except (MemoryError, RecursionError) as error:
        found = _no("too costly", type(error).__name__, "a PDF that unpacks to less")
    except Exception as error:  # whatever a broken file provokes is a refusal
        found = _no("a broken PDF", f"{type(error).__name__}: {error}"[:200], "a PDF that can be read")
    answer_to.write(msgspec.json.encode(found))
    answer_to.flush()
    os._exit(0)


def _read(data: bytes) -> Pages:
    import pypdf  # noqa: PLC0415  (only this process needs it)

    reader = pypdf.PdfReader(BytesIO(data))
    if reader.is_encrypted:
        return _no("an encrypted PDF", "a password", "no password")
    if len(reader.pages) > MOST_PAGES:
        return _no("too large", f"{len(reader.pages)} pages", f"{MOST_PAGES} pages")
    off = layers_off(reader)
    pages: list[str] = []
    lost: dict[str, list[str]] = {}
    for page in reader.pages:
        ink = Ink(page, off, lost)
        text: Any = page.extract_text(visitor_operand_before=ink.before, visitor_operand_after=ink.after)
        pages.append(str(text).strip())
        if sum(map(len, pages)) > LARGEST_READING:
            return _no("too large", f"over {LARGEST_READING} characters", f"{LARGEST_READING} characters")
    return Pages(tuple(pages), tuple(one for kind, pieces in lost.items() for one in noted(kind, pieces)))


def _no(what: str, got: str, allowed: str) -> Pages:
    return Pages(refused=Refused(what, got, allowed, "Print it to a new PDF, or convert it to Markdown."))


if __name__ == "__main__":
    with suppress(BrokenPipeError):
        main()
