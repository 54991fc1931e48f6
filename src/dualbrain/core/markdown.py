"""Markdown: tables, and untrusted text in it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from dualbrain.core.untrusted.visible_text import visible_text

MARKDOWN_SPECIAL_CHARACTERS = re.compile(r"([\\`*{}>#|!]|\](?=[(\[:])|(?<![^\W_])_|_(?![^\W_]))")
"""The characters that can begin or end markup.

A bracket does so only before "(", "[" or ":", and no underscore between letters or digits does, so that intervals and
names stay legible.
"""
HTML_SPECIAL_CHARACTERS = {"<": "&lt;", "&": "&amp;"}
"""Characters of HTML, before which not every reader of Markdown accepts a backslash."""
BLOCK_START = re.compile(r"\A(\d{0,9})([-+.)](?= |\Z)|-(?=-)|[~=]|\[(?=.*\]:))")
"""The beginning of a line that makes it a list item, a rule, a heading, a code block or the target of a link."""


def markdown_table(head: Sequence[object], rows: Iterable[Sequence[object]], *, pipe: str = "/") -> list[str]:
    """A Markdown table as lines. In cells, `pipe` replaces "|" and a space each newline: both would end the cell.

    Hidden characters are shown by their number (`visible_text`).
    """
    cells = ([visible_text(str(cell).replace("|", pipe).replace("\n", " ")) for cell in line] for line in (head, *rows))
    first, *others = ["| " + " | ".join(line) + " |" for line in cells]
    return [first, "| " + " | ".join(["---"] * len(head)) + " |", *others]


def code_span(text: str) -> str:
    """Untrusted text as code in a line: the fence is longer than every run of backticks in the text."""
    line = visible_text(" ".join(text.splitlines()))
    fence = "`" * (1 + max(map(len, re.findall("`+", line)), default=0))
    pad = " " if not line.strip() or line[0] == "`" or line[-1] == "`" else ""
    return f"{fence}{pad}{line}{pad}{fence}"


def escape_markdown(text: str) -> str:
    """Untrusted text with every Markdown character escaped and every hidden character visible, on one line.

    Text that consists of spaces is shown as "(blank)", because a list item or paragraph without text has another form.
    """
    line = " ".join(text.split())
    if text and not line:
        return "(blank)"
    escaped = MARKDOWN_SPECIAL_CHARACTERS.sub(r"\\\1", visible_text(line))
    return BLOCK_START.sub(r"\1\\\2", escaped.translate(str.maketrans(HTML_SPECIAL_CHARACTERS)))
