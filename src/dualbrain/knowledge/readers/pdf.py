"""PDF: the visible text by page, read in a process of its own with bounded time and memory.

A PDF may be a bomb (a kilobyte that unpacks to gigabytes, a maze of references), so whatever happens to the child
becomes a refusal here.
"""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec

import msgspec

from dualbrain.errors import UNREADABLE, InvalidSetup, MissingPart
from dualbrain.knowledge.readers.hidden_text import Hidden
from dualbrain.knowledge.rejection import Refused

CPU_S, WALL_S = 30, 60
MEMORY = 1 << 30
MOST_PAGES = 1000


class Pages(msgspec.Struct, frozen=True):
    """What the child found: the text of each page and what was hidden in them, or why it read nothing."""

    pages: tuple[str, ...] = ()
    hidden: tuple[Hidden, ...] = ()
    refused: Refused | None = None


def visible_text(data: bytes) -> tuple[str, tuple[int, ...], tuple[Hidden, ...]] | Refused:
    """The text of all pages, where each begins, and what was hidden (see `pdf_child`)."""
    if find_spec("pypdf") is None:
        raise MissingPart("The package pypdf", fix="Install it with `pip install 'dualbrain[knowledge]'`.")
    if not data.lstrip()[:5].startswith(b"%PDF-"):
        return Refused("not a PDF", ascii(data[:8])[2:-1], "a file that begins with %PDF-")
    found = _in_a_child(data)
    if isinstance(found, Refused):
        return found
    starts, length = list[int](), 0
    for page in found.pages:
        starts.append(length)
        length += len(page) + len(BETWEEN)
    return BETWEEN.join(found.pages), tuple(starts), found.hidden


BETWEEN = "\n\n"
"""What stands between two pages of a reading."""


def _in_a_child(data: bytes) -> Pages | Refused:
    """What the child says; one that was killed, by a signal or by the clock, had too much to do."""
    costly = Refused(
        "too costly", f"more than {CPU_S} s or {MEMORY >> 20} MB to read", "less", "Print it to a new PDF."
    )
    alike = ["-S"] if sys.flags.no_site else []  # the child finds its packages as we do
    command = [sys.executable, *alike, "-m", "dualbrain.knowledge.readers.pdf_worker"]
    try:
        done = subprocess.run(command, input=data, capture_output=True, timeout=WALL_S, check=False)
    except subprocess.TimeoutExpired:
        return costly
    if done.returncode < 0:
        return costly
    try:
        found = msgspec.json.decode(done.stdout, type=Pages)
    except UNREADABLE as error:
        said = done.stderr.decode("utf-8", "replace")[-300:]
        raise InvalidSetup("the reader of PDF files", got=said, allowed="an answer") from error
    return found.refused or found
