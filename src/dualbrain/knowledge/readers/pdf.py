"""PDF: the visible text by page, read in a process of its own with bounded time and memory.

A PDF may be a bomb (a kilobyte that unpacks to gigabytes, a maze of references), so whatever happens to the child
becomes a refusal here.
"""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec

import msgspec

from dualbrain.errors import DECODE_ERRORS, ConfigurationError, MissingDependencyError
from dualbrain.knowledge.readers.hidden_text import HiddenText
from dualbrain.knowledge.rejection import DocumentRejected

CPU_LIMIT_S, WALL_LIMIT_S = 30, 60
MEMORY_LIMIT_BYTES = 1 << 30
MAX_PAGES = 1000


class PdfPages(msgspec.Struct, frozen=True):
    """What the child found: the text of each page and what was hidden in them, or why it read nothing."""

    pages: tuple[str, ...] = ()
    hidden: tuple[HiddenText, ...] = ()
    refused: DocumentRejected | None = None


def visible_text(data: bytes) -> tuple[str, tuple[int, ...], tuple[HiddenText, ...]] | DocumentRejected:
    """The text of all pages, where each begins, and what was hidden (see `pdf_child`)."""
    if find_spec("pypdf") is None:
        raise MissingDependencyError("The package pypdf", fix="Install it with `pip install 'dualbrain[knowledge]'`.")
    if not data.lstrip()[:5].startswith(b"%PDF-"):
        return DocumentRejected("not a PDF", ascii(data[:8])[2:-1], "a file that begins with %PDF-")
    found = _read_in_worker(data)
    if isinstance(found, DocumentRejected):
        return found
    starts, length = list[int](), 0
    for page in found.pages:
        starts.append(length)
        length += len(page) + len(PAGE_SEPARATOR)
    return PAGE_SEPARATOR.join(found.pages), tuple(starts), found.hidden


PAGE_SEPARATOR = "\n\n"
"""What stands between two pages of a reading."""


def _read_in_worker(data: bytes) -> PdfPages | DocumentRejected:
    """What the child says; one that was killed, by a signal or by the clock, had too much to do."""
    costly = DocumentRejected(
        "too costly",
        f"more than {CPU_LIMIT_S} s or {MEMORY_LIMIT_BYTES >> 20} MB to read",
        "less",
        "Print it to a new PDF.",
    )
    alike = ["-S"] if sys.flags.no_site else []  # the child finds its packages as we do
    command = [sys.executable, *alike, "-m", "dualbrain.knowledge.readers.pdf_worker"]
    try:
        done = subprocess.run(command, input=data, capture_output=True, timeout=WALL_LIMIT_S, check=False)
    except subprocess.TimeoutExpired:
        return costly
    if done.returncode < 0:
        return costly
    try:
        found = msgspec.json.decode(done.stdout, type=PdfPages)
    except DECODE_ERRORS as error:
        said = done.stderr.decode("utf-8", "replace")[-300:]
        raise ConfigurationError("the reader of PDF files", got=said, allowed="an answer") from error
    return found.refused or found
