"""A reading in chunks: short pieces with exact offsets that begin and end where the document does.

Law: every chunk is `text[start:end]` of its reading, no two overlap, none crosses a page, and what lies between them is
white space and headings. A heading is not lost: it stands in the `path` of what follows it.
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
"""Characters of a chunk: some 120 tokens, so that three of them are a small part of a prompt."""
MAX_ENTRY_CHARACTERS = 2000
"""Characters of one entry of a TOML file, which is quoted whole or not at all."""

_BREAKS = (re.compile(r"\n"), re.compile(r"(?<=[.!?:;])\s"), re.compile(r"\s"))
"""Where a block that is too long may be cut, the best place first: line, sentence, word."""
_PARAGRAPH = re.compile(r"\S(?:[^\n]|\n(?![ \t]*\n))*")
_TABLE = re.compile(r"^\[", re.MULTILINE)


class Chunk(NamedTuple):
    """`reading.text[start:end]`; `path` are the headings it stands under, outermost first; `page` counts from 1."""

    start: int
    end: int
    page: int | None
    path: tuple[str, ...]


class _Block(NamedTuple):
    start: int
    end: int
    path: tuple[str, ...]


def split_chunks(reading: DocumentText) -> tuple[Chunk, ...]:
    """All chunks of `reading` in their order."""
    find = {"markdown": _markdown_blocks, "html": _markdown_blocks, "toml": _toml_tables}.get(
        reading.media, _paragraphs
    )
    whole = [block for block in find(reading.text) if reading.text[block.start : block.end].strip()]
    by_page = (part for block in whole for part in _split_at_pages(reading, block))
    longest = MAX_ENTRY_CHARACTERS if reading.media == "toml" else MAX_CHUNK_CHARACTERS
    short = [part for block in by_page for part in _split_long(reading.text, block, longest)]
    return tuple(
        Chunk(block.start, block.end, reading.page_at(block.start), block.path)
        for block in _merge_adjacent(reading, short, join=reading.media != "toml")
    )


def _markdown_blocks(text: str) -> Iterator[_Block]:
    """Top-level blocks under their headings."""
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
    """The tables of a TOML file: each entry of a map or template is a chunk of its own."""
    begins = [0, *(match.start() for match in _TABLE.finditer(text) if match.start()), len(text)]
    for start, end in pairwise(begins):
        name = re.search(r"^(?:name|title)\s*=\s*\"([^\"\n]*)\"", text[start:end], re.MULTILINE)
        yield _Block(start, end, (name[1],) if name else ())


def _paragraphs(text: str) -> Iterator[_Block]:
    for match in _PARAGRAPH.finditer(text):
        yield _Block(*match.span(), ())


def _split_at_pages(reading: DocumentText, block: _Block) -> Iterator[_Block]:
    """`block` cut where pages begin."""
    cuts = [start for start in reading.pages if block.start < start < block.end]
    edges = [block.start, *cuts, block.end]
    for start, end in pairwise(edges):
        yield _Block(start, end, block.path)


def _split_long(text: str, block: _Block, longest: int) -> Iterator[_Block]:
    """`block` without white space around it, cut into pieces of at most `longest` characters."""
    start, end = _strip_span(text, block.start, block.end)
    while end - start > longest:
        cut = _find_cut(text, start, longest)
        left = _strip_span(text, start, cut)
        if left[0] < left[1]:
            yield _Block(*left, block.path)
        start, end = _strip_span(text, cut, end)
    if start < end:
        yield _Block(start, end, block.path)


def _find_cut(text: str, start: int, longest: int) -> int:
    """Where a piece that begins at `start` ends: the last good break in its second half, else at full length."""
    for pattern in _BREAKS:
        places = [match.end() for match in pattern.finditer(text, start + longest // 2, start + longest)]
        if places:
            return places[-1]
    return start + longest


def _strip_span(text: str, start: int, end: int) -> Span:
    inner = text[start:end]
    left = len(inner) - len(inner.lstrip())
    return start + left, start + max(left, len(inner.rstrip()))


def _merge_adjacent(reading: DocumentText, parts: list[_Block], *, join: bool) -> Iterator[_Block]:
    """Neighbours under one heading and on one page in one chunk, while it stays short."""
    held: _Block | None = None
    for part in parts:
        if held is not None and join and _can_merge(reading, held, part):
            held = _Block(held.start, part.end, held.path)
            continue
        if held is not None:
            yield held
        held = part
    if held is not None:
        yield held


def _can_merge(reading: DocumentText, held: _Block, part: _Block) -> bool:
    alike = held.path == part.path and reading.page_at(held.start) == reading.page_at(part.start)
    return alike and part.end - held.start <= MAX_CHUNK_CHARACTERS
