"""Reader of PDF: the visible text of each page, read in a separate process with bounded time and memory.

A PDF may be malicious (a kilobyte that unpacks to gigabytes, circular references), so every failure of the process
becomes a rejection.
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
    """Reply of the process: the text of each page and the hidden text, or the reason of a rejection."""

    pages: tuple[str, ...] = ()
    hidden: tuple[HiddenText, ...] = ()
    rejection: DocumentRejected | None = None


def visible_text(data: bytes) -> tuple[str, tuple[int, ...], tuple[HiddenText, ...]] | DocumentRejected:
    """The text of all pages, the offset of each page, and the hidden text (see `pdf_worker`).

    Raises `MissingDependencyError` without pypdf, and `ConfigurationError` if the process sends no reply.
    """
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
"""Separator between two pages in a document text."""


def _read_in_worker(data: bytes) -> PdfPages | DocumentRejected:
    """The reply of the process; a process that exceeds its limits and is killed is a rejection."""
    too_costly = DocumentRejected(
        "too costly",
        f"more than {CPU_LIMIT_S} s or {MEMORY_LIMIT_BYTES >> 20} MB to read",
        "less",
        "Print it to a new PDF.",
    )
    flags = ["-S"] if sys.flags.no_site else []  # so that the process finds the same packages
    command = [sys.executable, *flags, "-m", "dualbrain.knowledge.readers.pdf_worker"]
    try:
        done = subprocess.run(command, input=data, capture_output=True, timeout=WALL_LIMIT_S, check=False)
    except subprocess.TimeoutExpired:
        return too_costly
    if done.returncode < 0:
        return too_costly
    try:
        found = msgspec.json.decode(done.stdout, type=PdfPages)
    except DECODE_ERRORS as error:
        stderr = done.stderr.decode("utf-8", "replace")[-300:]
        raise ConfigurationError.stating(f"The reader of PDF files sent no reply. Its output: {stderr}") from error
    return found.rejection or found
