"""Reader of Markdown: text that a renderer would not show becomes blanks, so that offsets are those of the source.

Hidden are comments, the parts that `markdown_visibility` finds (such as link targets and definitions), and raw HTML
elements with attributes or without a display (script, style, template …), including their content; of a plain raw
element (`<b>`, `<br>`) only the tags are hidden. Fenced and indented code stays, because every renderer shows it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple, cast

from dualbrain.knowledge.readers.hidden_text import HiddenText, Span, blank_spans, summarize_hidden
from dualbrain.knowledge.readers.markdown_visibility import find_structure, line_starts, make_parser

_COMMENT = re.compile(
    r"<!--.*?(?:-->|\Z)|<\?.*?(?:\?>|\Z)|<!\[CDATA\[.*?(?:\]\]>|\Z)|<![A-Za-z][^>]*(?:>|\Z)", re.DOTALL
)
_DEFINITION = re.compile(r"^ {0,3}\[[^\]\n]{1,500}\]:[^\n]*(?:\n[ \t]+[\"'(][^\n]*)?", re.MULTILINE)
_TARGET = re.compile(r"(?<=\])\([^()\n]{0,500}(?:\([^()\n]{0,200}\)[^()\n]{0,200}){0,4}\)")
_PATTERNS = {"comments": _COMMENT, "link definitions": _DEFINITION, "link targets": _TARGET}
"""Also hidden is text that some renderer takes for one of these."""
_PASSES = 2
"""Number of passes, because hidden text may divide a link that is one without it."""
_TAG = re.compile(
    r"<(?P<closes>/?)(?P<name>[A-Za-z][A-Za-z0-9-]*)"
    r"(?P<attributes>(?:\s(?:\"[^\"]{0,2000}\"|'[^']{0,2000}'|[^'\"<>])*)?)/?>"
)
_NEVER_SHOWN = frozenset(
    {
        *("script", "style", "template", "head", "title", "noscript", "noframes", "noembed", "iframe", "object", "svg"),
        *(
            "math",
            "canvas",
            "audio",
            "video",
            "select",
            "textarea",
            "datalist",
            "dialog",
            "details",
            "meter",
            "progress",
        ),
    }
)
_VOID = frozenset({"br", "hr", "img", "input", "wbr", "meta", "link", "source", "area", "base", "col", "embed"})


class TextBlock(NamedTuple):
    """Characters `start` to `end` of a text; `path` contains the headings above, outermost first."""

    start: int
    end: int
    path: tuple[str, ...]


def visible_text(text: str) -> tuple[str, tuple[int, ...], tuple[HiddenText, ...]]:
    """`text` with blanks for hidden text, of the same length; no page starts; and the hidden text."""
    text = text.replace("\r", " ") if "\r\n" in text else text.replace("\r", "\n")
    pieces: dict[str, list[str]] = {}
    for _ in range(_PASSES):
        before, text = text, _blank_once(text, pieces)
        if text == before:
            break
    hidden = (summarize_hidden(kind, found) for kind, found in pieces.items())
    return text, (), tuple(one for found in hidden for one in found)


def _blank_once(text: str, pieces: dict[str, list[str]]) -> str:
    """`text` with blanks for hidden text, which is added to `pieces` by kind."""
    structure = find_structure(text)
    for kind, find in _PATTERNS.items():
        spans = [match.span() for match in find.finditer(blank_spans(text, structure.code))]
        text = _blank(text, kind, [*spans, *structure.hidden.pop(kind, ())], pieces)
    for kind, spans in structure.hidden.items():
        text = _blank(text, kind, spans, pieces)
    return _blank(text, "raw HTML", list(_raw_elements(blank_spans(text, structure.code))), pieces)


def _blank(text: str, kind: str, spans: list[Span], pieces: dict[str, list[str]]) -> str:
    pieces.setdefault(kind, []).extend(text[start:end] for start, end in _merge(spans))
    return blank_spans(text, spans)


def _merge(spans: list[Span]) -> Iterator[Span]:
    """`spans` in order, without overlaps."""
    end = 0
    for start, stop in sorted(spans):
        if stop > end:
            yield max(start, end), stop
            end = stop


def find_blocks(text: str) -> Iterator[TextBlock]:
    """The top-level blocks of Markdown, apart from headings, with the headings above them."""
    starts, path = line_starts(text), list[tuple[int, str]]()
    tokens = make_parser().parse(text)
    for token, after in zip(tokens, [*tokens, None][1:], strict=True):
        if token.level or token.map is None or token.nesting < 0:
            continue
        first, last = cast("tuple[int, int]", token.map)
        start, end = starts[first], starts[min(last, len(starts) - 1)]
        if token.type == "heading_open":
            level = int(token.tag[1:])
            title = " ".join(after.content.split()) if after is not None else ""
            path = [*(above for above in path if above[0] < level), (level, title)]
        else:
            yield TextBlock(start, end, tuple(title for _, title in path if title))


def _raw_elements(text: str) -> Iterator[Span]:
    """Spans of hidden raw HTML; an element that is never closed hides the rest of the document."""
    element, start, depth = "", 0, 0
    for match in _TAG.finditer(text):
        opens, name = not match["closes"], match["name"].lower()
        if depth:
            depth += (1 if opens else -1) if name == element else 0
            if not depth:
                yield start, match.end()
        elif opens and name not in _VOID and (match["attributes"].strip(" /") or name in _NEVER_SHOWN):
            element, start, depth = name, match.start(), 1
        else:
            yield match.span()
    if depth:
        yield start, len(text)
