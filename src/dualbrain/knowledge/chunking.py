"""Splitting of a document text into chunks: short passages with exact offsets.

Law: every chunk is `text[start:end]` of its document text, no two chunks overlap, no chunk crosses a page, and only
white space and headings are between chunks. Headings are kept in the `path` of the chunks below them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple, cast

from dualbrain.knowledge.readers.hidden_text import Span
from dualbrain.knowledge.readers.markdown import line_starts, parse_blocks
from dualbrain.knowledge.readers.reader import DocumentText

MAX_CHUNK_CHARACTERS = 480
"""Largest length of a chunk: about 120 tokens, so that three chunks are a small part of a prompt."""
MAX_ENTRY_CHARACTERS = 2000
"""Largest length of one entry of a TOML file, which is quoted as a whole."""

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


class _Block(NamedTuple):
    start: int
    end: int
    path: tuple[str, ...]


def split_chunks(document_text: DocumentText) -> tuple[Chunk, ...]:
    """All chunks of `document_text` in their order."""
    find_blocks = {"markdown": _markdown_blocks, "html": _markdown_blocks, "toml": _toml_tables}.get(
        document_text.media, _paragraphs
    )
    blocks = [block for block in find_blocks(document_text.text) if document_text.text[block.start : block.end].strip()]
    by_page = (part for block in blocks for part in _split_at_pages(document_text, block))
    longest = MAX_ENTRY_CHARACTERS if document_text.media == "toml" else MAX_CHUNK_CHARACTERS
    short = [part for block in by_page for part in _split_long(document_text.text, block, longest)]
    return tuple(
        Chunk(block.start, block.end, document_text.page_at(block.start), block.path)
        for block in _merge_adjacent(document_text, short, join=document_text.media != "toml")
    )


def _markdown_blocks(text: str) -> Iterator[_Block]:
    """Top-level blocks with the headings above them."""
    starts, path = line_starts(text), list[tuple[int, str]]()
    tokens = parse_blocks(text)
    for token, after in zip(tokens, [*tokens[1:], None], strict=True):
        if token.level or token.map is None or token.nesting < 0:
            continue
        first, last = cast("tuple[int, int]", token.map)
        start, end = starts[first], starts[min(last, len(starts) - 1)]
        if token.type == "heading_open":
            level = int(token.tag[1:])
            title = " ".join(after.content.split()) if after is not None else ""
            path = [*(above for above in path if above[0] < level), (level, title)]
        else:
            yield _Block(start, end, tuple(title for _, title in path if title))


def _toml_tables(text: str) -> Iterator[_Block]:
    """The tables of a TOML file: each entry of a map or template document is one chunk."""
    starts = [0, *(match.start() for match in _TABLE.finditer(text) if match.start()), len(text)]
    for start, end in pairwise(starts):
        name = re.search(r"^(?:name|title)\s*=\s*\"([^\"\n]*)\"", text[start:end], re.MULTILINE)
        yield _Block(start, end, (name[1],) if name else ())


def _paragraphs(text: str) -> Iterator[_Block]:
    for match in _PARAGRAPH.finditer(text):
        yield _Block(*match.span(), ())


def _split_at_pages(document_text: DocumentText, block: _Block) -> Iterator[_Block]:
    """`block`, cut at the starts of pages."""
    cuts = [start for start in document_text.pages if block.start < start < block.end]
    edges = [block.start, *cuts, block.end]
    for start, end in pairwise(edges):
        yield _Block(start, end, block.path)


def _split_long(text: str, block: _Block, longest: int) -> Iterator[_Block]:
    """`block` without surrounding white space, cut into pieces of at most `longest` characters."""
    start, end = _strip_span(text, block.start, block.end)
    while end - start > longest:
        cut = _find_cut(text, start, longest)
        piece = _strip_span(text, start, cut)
        if piece[0] < piece[1]:
            yield _Block(*piece, block.path)
        start, end = _strip_span(text, cut, end)
    if start < end:
        yield _Block(start, end, block.path)


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


def _merge_adjacent(document_text: DocumentText, parts: list[_Block], *, join: bool) -> Iterator[_Block]:
    """Merge adjacent blocks with the same headings and page, up to the largest length of a chunk."""
    merged: _Block | None = None
    for part in parts:
        if merged is not None and join and _can_merge(document_text, merged, part):
            merged = _Block(merged.start, part.end, merged.path)
            continue
        if merged is not None:
            yield merged
        merged = part
    if merged is not None:
        yield merged


def _can_merge(document_text: DocumentText, merged: _Block, part: _Block) -> bool:
    same_place = merged.path == part.path and document_text.page_at(merged.start) == document_text.page_at(part.start)
    return same_place and part.end - merged.start <= MAX_CHUNK_CHARACTERS
