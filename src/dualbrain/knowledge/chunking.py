"""Splitting of a document text into chunks: short passages with exact offsets.

Law: every chunk is `text[start:end]` of its document text, no two chunks overlap, no chunk crosses a page, and only
white space and headings are between chunks. Headings are kept in the `path` of the chunks below them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

from dualbrain.knowledge.readers.hidden_text import Span
from dualbrain.knowledge.readers.markdown import TextBlock
from dualbrain.knowledge.readers.reader import BLOCK_MEDIA, DocumentText

MAX_CHUNK_CHARACTERS = 480
"""Largest length of a chunk: about 120 tokens, so that three chunks are a small part of a prompt."""
MAX_ENTRY_CHARACTERS = 2000
"""Largest length of one entry of a map or of templates in TOML, which is not split to be shown."""

_BREAKS = (re.compile(r"\n"), re.compile(r"(?<=[.!?:;])\s"), re.compile(r"\s"))
"""Breaks at which a long block is cut, in order of preference: line, sentence, word."""
_PARAGRAPH = re.compile(r"\S(?:[^\n]|\n(?![ \t]*\n))*")
_TABLE = re.compile(r"^\[", re.MULTILINE)


class Chunk(NamedTuple):
    """Characters `start` to `end` of a document text.

    `path` contains the headings above the chunk, outermost first; `page` counts from 1, None without pages.
    """

    start: int
    end: int
    page: int | None
    path: tuple[str, ...]


def split_chunks(document_text: DocumentText, *, whole_entries: bool = True) -> tuple[Chunk, ...]:
    """All chunks of `document_text` in their order; with `whole_entries` an entry of a TOML file is one chunk."""
    find_blocks = {"toml": _toml_tables}.get(document_text.media, _paragraphs)
    found = document_text.blocks if document_text.media in BLOCK_MEDIA else find_blocks(document_text.text)
    blocks = [block for block in found if document_text.text[block.start : block.end].strip()]
    by_page = (part for block in blocks for part in _split_at_pages(document_text, block))
    longest = MAX_ENTRY_CHARACTERS if document_text.media == "toml" and whole_entries else MAX_CHUNK_CHARACTERS
    short = [part for block in by_page for part in _split_long(document_text.text, block, longest)]
    return tuple(
        Chunk(block.start, block.end, document_text.page_at(block.start), block.path)
        for block in _merge_adjacent(document_text, short, join=document_text.media != "toml")
    )


def _toml_tables(text: str) -> Iterator[TextBlock]:
    """The tables of a TOML file: each entry of a map or template document is one chunk."""
    starts = [0, *(match.start() for match in _TABLE.finditer(text) if match.start()), len(text)]
    for start, end in pairwise(starts):
        name = re.search(r"^(?:name|title)\s*=\s*\"([^\"\n]*)\"", text[start:end], re.MULTILINE)
        yield TextBlock(start, end, (name[1],) if name else ())


def _paragraphs(text: str) -> Iterator[TextBlock]:
    for match in _PARAGRAPH.finditer(text):
        yield TextBlock(*match.span(), ())


def _split_at_pages(document_text: DocumentText, block: TextBlock) -> Iterator[TextBlock]:
    """`block`, cut at the starts of pages."""
    cuts = [start for start in document_text.pages if block.start < start < block.end]
    edges = [block.start, *cuts, block.end]
    for start, end in pairwise(edges):
        yield TextBlock(start, end, block.path)


def _split_long(text: str, block: TextBlock, longest: int) -> Iterator[TextBlock]:
    """`block` without surrounding white space, cut into pieces of at most `longest` characters."""
    start, end = _strip_span(text, block.start, block.end)
    while end - start > longest:
        cut = _find_cut(text, start, longest)
        piece = _strip_span(text, start, cut)
        if piece[0] < piece[1]:
            yield TextBlock(*piece, block.path)
        start, end = _strip_span(text, cut, end)
    if start < end:
        yield TextBlock(start, end, block.path)


def _find_cut(text: str, start: int, longest: int) -> int:
    """End of a piece that begins at `start`: the last preferred break in its second half, otherwise full length."""
    for pattern in _BREAKS:
        breaks = [match.end() for match in pattern.finditer(text, start + longest // 2, start + longest)]
        if breaks:
            return breaks[-1]
    return start + longest


def _strip_span(text: str, start: int, end: int) -> Span:
    inner = text[start:end]
    left = len(inner) - len(inner.lstrip())
    return start + left, start + max(left, len(inner.rstrip()))


def _merge_adjacent(document_text: DocumentText, parts: list[TextBlock], *, join: bool) -> Iterator[TextBlock]:
    """Merge adjacent blocks with the same headings and page, up to the largest length of a chunk."""
    merged: TextBlock | None = None
    for part in parts:
        if merged is not None and join and _can_merge(document_text, merged, part):
            merged = TextBlock(merged.start, part.end, merged.path)
            continue
        if merged is not None:
            yield merged
        merged = part
    if merged is not None:
        yield merged


def _can_merge(document_text: DocumentText, merged: TextBlock, part: TextBlock) -> bool:
    same_place = merged.path == part.path and document_text.page_at(merged.start) == document_text.page_at(part.start)
    return same_place and part.end - merged.start <= MAX_CHUNK_CHARACTERS
