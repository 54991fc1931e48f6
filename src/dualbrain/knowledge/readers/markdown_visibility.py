"""Parts of a Markdown text that are not shown, found by the parser, and its code blocks, which are.

Titles and labels of links may contain any text, also brackets and line ends, so that a pattern cannot find their end.
Positions are those of the source: the parser gives the lines of each block, and rules of the parser record the links
and images in its text.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

from dualbrain.errors import MissingDependencyError
from dualbrain.knowledge.readers.hidden_text import Span

_CELL_END = re.compile(r"(?<!\\)\|")
_CONTAINER = re.compile(r"[ \t>]*")
"""Marks of quotations before a row of a table."""


@dataclass(frozen=True, slots=True)
class MarkdownStructure:
    """Spans of the `code` blocks, without the fences before them, and of hidden text by kind."""

    code: list[Span] = field(default_factory=list[Span])
    hidden: dict[str, list[Span]] = field(default_factory=dict[str, list[Span]])

    def hide(self, kind: str, *spans: Span) -> None:
        """Add hidden `spans` of this `kind`."""
        self.hidden.setdefault(kind, []).extend(spans)


def make_parser() -> Any:
    """A parser of the blocks of CommonMark and tables; raises `MissingDependencyError` without markdown-it-py."""
    try:
        return import_module("markdown_it").MarkdownIt("commonmark").enable("table").disable("inline")
    except ImportError as error:
        fix = "Install it with `pip install 'dualbrain[knowledge]'`."
        raise MissingDependencyError("The package markdown-it-py", fix=fix) from error


def line_starts(text: str) -> list[int]:
    """The offset of the start of each line, and the length of the text."""
    return [0, *(match.end() for match in re.finditer(r"\n", text)), len(text)]


def find_structure(text: str) -> MarkdownStructure:
    """The code blocks of `text`, and the parts that are not shown.

    Hidden are the labels of fenced code, the definitions, targets and labels of links, images with their descriptions,
    and the cells of a table row beyond its header.
    """
    found, recorder, lines = MarkdownStructure(), _LinkRecorder(), _Lines(text)
    environment: dict[str, Any] = {}
    tokens: list[Any] = recorder.parser.parse(text, environment)
    for one in (*environment.get("references", {}).values(), *environment.get("duplicate_refs", ())):
        found.hide("link definitions", lines.span(*one["map"]))
    for token in tokens:
        if token.type == "code_block":
            found.code.append(lines.span(*token.map))
        elif token.type == "fence":
            first, end = lines.span(*token.map)
            body = min(lines.span(token.map[0], token.map[0] + 1)[1], end)
            found.code.append((body, end))
            found.hide("labels of code", (text.index(token.markup, first) + len(token.markup), body))
        elif token.type == "inline":
            positions = lines.positions(token)
            for kind, start, end in recorder.record(token.content, environment) if "]" in token.content else ():
                found.hide(kind, *lines.locate(token, positions, start, end))
    found.hide("table cells beyond the header", *_excess_cells(tokens, lines))
    return found


class _Lines:
    """The lines of a text."""

    def __init__(self, text: str) -> None:
        self.text, self._starts = text, line_starts(text)
        self._located: dict[int, int] = {}
        """For each line, the offset up to which its cells were located."""

    def span(self, first: int, last: int) -> Span:
        """The span of the lines from `first` to before `last`."""
        end = len(self._starts) - 1
        return self._starts[min(first, end)], self._starts[min(last, end)]

    def positions(self, token: Any) -> list[int]:
        """The offset of each line of the content of the inline `token`; -1 for a line that was changed by the parser.

        The cells of a row have to be given in their order.
        """
        found: list[int] = []
        for number, content in enumerate(token.content.split("\n"), start=token.map[0]):
            start, end = self.span(number, number + 1)
            inner = content.strip()
            at = self.text.find(inner, self._located.get(number, start), end)
            if at >= 0:
                self._located[number] = at + len(inner)
            found.append(at - (len(content) - len(content.lstrip())) if at >= 0 else -1)
        return found

    def locate(self, token: Any, positions: list[int], start: int, end: int) -> Iterator[Span]:
        """The spans of the characters `start` to `end` of the content of `token`, line by line.

        A line that was changed by the parser, such as a cell with an escaped bar, is taken as a whole.
        """
        offset = 0
        for number, (content, at) in enumerate(
            zip(token.content.split("\n"), positions, strict=True), start=token.map[0]
        ):
            first, last = max(start - offset, 0), min(end - offset, len(content))
            if first < last:
                yield self.span(number, number + 1) if at < 0 else (at + first, at + last)
            offset += len(content) + 1


class _LinkRecorder:
    """A parser that records links and images: the part of a link after its text, and the whole of an image."""

    def __init__(self) -> None:
        self.parser = make_parser()
        self._text = ""
        self._found: list[tuple[str, int, int]] = []
        rules, inline = self.parser.inline.ruler, import_module("markdown_it.rules_inline")
        rules.at("link", self._recording(inline.link, "link targets"))
        rules.at("image", self._recording(inline.image, "images"))

    def record(self, text: str, environment: dict[str, Any]) -> list[tuple[str, int, int]]:
        """Kind, start and end of each hidden part of the `text` of a block."""
        self._text, self._found = text, []
        self.parser.inline.parse(text, self.parser, environment, [])
        return self._found

    def _recording(self, rule: Callable[..., bool], kind: str) -> Callable[..., bool]:
        def recording(state: Any, silent: bool) -> bool:
            start: int = state.pos
            matches = rule(state, silent)
            if matches and not silent and state.src is self._text:  # not in the description of an image
                label = state.md.helpers.parseLinkLabel
                hidden = start if kind == "images" else label(state, start, disableNested=True) + 1
                self._found += [(kind, hidden, state.pos)] if hidden < state.pos else []
            return matches

        return recording


def _excess_cells(tokens: list[Any], lines: _Lines) -> Iterator[Span]:
    """The parts of the rows of tables after as many cells as the header has."""
    columns = 0
    for token in tokens:
        if token.type == "table_open":
            columns = 0
        columns += token.type == "th_open"
        if token.type == "tr_open" and columns:
            start, end = lines.span(*token.map)
            margin = _CONTAINER.match(lines.text, start, end)
            ends = [match.end() for match in _CELL_END.finditer(lines.text, margin.end() if margin else start, end)]
            first = columns if ends and margin and ends[0] == margin.end() + 1 else columns - 1
            if first < len(ends) and lines.text[ends[first] : end].strip(" \t\n|"):
                yield ends[first], end
