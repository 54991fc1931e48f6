"""Extraction of the text of one document in a bounded process: `reader` starts it, and nothing else calls it.

The functions take the bytes of a file and return an encoded `Extraction`.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec

import msgspec

from dualbrain.knowledge.readers import html, markdown, pdf
from dualbrain.knowledge.readers.hidden_text import HiddenText, blank_hidden
from dualbrain.knowledge.readers.markdown import TextBlock
from dualbrain.knowledge.rejection import DocumentRejected

_PACKAGES = {
    "extract_markdown": ("markdown_it",),
    "extract_html": ("selectolax.lexbor", "tinycss2.color5", "markdown_it"),
    "extract_pdf": ("pypdf",),
}
"""Packages of each function, which are imported before the limits of the process apply."""


class Extraction(msgspec.Struct, frozen=True, kw_only=True):
    """Text, the offset of the start of each page, the blocks of the text, and the hidden texts; or a rejection.

    The text is complete except for invisible characters and chat tokens, which `hidden_text` blanks with the same
    offsets.
    """

    text: str = ""
    pages: tuple[int, ...] = ()
    blocks: tuple[TextBlock, ...] = ()
    hidden: tuple[HiddenText, ...] = ()
    rejection: DocumentRejected | None = None


def prepare_process(function: str) -> None:
    """Import the packages of `function`; it reports a missing one itself."""
    for package in _PACKAGES[function]:
        if find_spec(package.partition(".")[0]) is not None:
            import_module(package)


def extract_markdown(data: bytes) -> bytes:
    """The text of a Markdown file."""
    return _encode(*markdown.visible_text(data.decode("utf-8")), blocks=True)


def extract_html(data: bytes) -> bytes:
    """The text of a page of HTML."""
    found = html.visible_text(data.decode("utf-8"))
    return _rejected(found) if isinstance(found, DocumentRejected) else _encode(*found, blocks=True)


def extract_pdf(data: bytes) -> bytes:
    """The text of a PDF."""
    found = pdf.visible_text(data)
    return _rejected(found) if isinstance(found, DocumentRejected) else _encode(*found, blocks=False)


def _encode(text: str, pages: tuple[int, ...], hidden: tuple[HiddenText, ...], *, blocks: bool) -> bytes:
    """The extraction of `text`; its blocks are those of the text after blanking, which is the stored text."""
    found = tuple(markdown.find_blocks(blank_hidden(text)[0])) if blocks else ()
    storable = text.encode("utf-8", "replace").decode("utf-8")
    return msgspec.msgpack.encode(Extraction(text=storable, pages=pages, blocks=found, hidden=hidden))


def _rejected(rejection: DocumentRejected) -> bytes:
    return msgspec.msgpack.encode(Extraction(rejection=rejection))
