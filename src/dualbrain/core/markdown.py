"""Markdown tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from dualbrain.core.untrusted.visible_text import visible_text


def markdown_table(head: Sequence[object], rows: Iterable[Sequence[object]], *, pipe: str = "/") -> list[str]:
    """A Markdown table as lines. In cells, `pipe` replaces "|" and a space each newline: both would end the cell.

    Hidden characters are shown by their number (`visible_text`).
    """
    cells = ([visible_text(str(cell).replace("|", pipe).replace("\n", " ")) for cell in line] for line in (head, *rows))
    first, *others = ["| " + " | ".join(line) + " |" for line in cells]
    return [first, "| " + " | ".join(["---"] * len(head)) + " |", *others]
