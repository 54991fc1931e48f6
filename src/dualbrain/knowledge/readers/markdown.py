"""Reader of Markdown: text that a renderer would not show becomes blanks, so that offsets are those of the source.

Hidden are comments, link targets and definitions, and raw HTML elements with attributes or without a display (script,
style, template …), including their content; of a plain raw element (`<b>`, `<br>`) only the tags are hidden. Fenced and
indented code stays, because every renderer shows it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib import import_module
from typing import Any, NamedTuple, cast

from dualbrain.errors import MissingDependencyError
from dualbrain.knowledge.readers.hidden_text import HiddenText, Span, blank_spans, summarize_hidden

_COMMENT = re.compile(
    r"<!--.*?(?:-->|\Z)|<\?.*?(?:\?>|\Z)|<!\[CDATA\[.*?(?:\]\]>|\Z)|<![A-Za-z][^>]*(?:>|\Z)", re.DOTALL
)
_DEFINITION = re.compile(r"^ {0,3}\[[^\]\n]{1,500}\]:[^\n]*(?:\n[ \t]+[\"'(][^\n]*)?", re.MULTILINE)
_TARGET = re.compile(r"(?<=\])\([^()\n]{0,500}(?:\([^()\n]{0,200}\)[^()\n]{0,200}){0,4}\)")
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


def parse_blocks(text: str) -> list[Any]:
    """The CommonMark tokens of `text`, with tables; raises `MissingDependencyError` without markdown-it-py."""
    try:
        parser: Any = import_module("markdown_it").MarkdownIt("commonmark").enable("table")
    except ImportError as error:
        fix = "Install it with `pip install 'dualbrain[knowledge]'`."
        raise MissingDependencyError("The package markdown-it-py", fix=fix) from error
    return parser.parse(text)


def line_starts(text: str) -> list[int]:
    """The offset of the start of each line, and the length of the text."""
    return [0, *(match.end() for match in re.finditer(r"\n", text)), len(text)]


def visible_text(text: str) -> tuple[str, tuple[int, ...], tuple[HiddenText, ...]]:
    """`text` with blanks for hidden text, of the same length; no page starts; and the hidden text."""
    text = text.replace("\r", " ") if "\r\n" in text else text.replace("\r", "\n")
    hidden: tuple[HiddenText, ...] = ()
    code = list(_code_spans(text))
    for kind, find in (("comments", _COMMENT), ("link definitions", _DEFINITION), ("link targets", _TARGET)):
        spans = [match.span() for match in find.finditer(blank_spans(text, code))]
        hidden += summarize_hidden(kind, [text[start:end] for start, end in spans])
        text = blank_spans(text, spans)
    spans = list(_raw_elements(blank_spans(text, code)))
    hidden += summarize_hidden("raw HTML", [text[start:end] for start, end in spans])
    return blank_spans(text, spans), (), hidden


def find_blocks(text: str) -> Iterator[TextBlock]:
    """The top-level blocks of Markdown, apart from headings, with the headings above them."""
    starts, path = line_starts(text), list[tuple[int, str]]()
    tokens = parse_blocks(text)
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


def _code_spans(text: str) -> Iterator[Span]:
    """Spans of code, which every renderer shows."""
    starts = line_starts(text)
    for token in parse_blocks(text):
        if token.type in {"fence", "code_block"}:
            yield starts[token.map[0]], starts[min(token.map[1], len(starts) - 1)]


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
