"""What people and programs are told: a reader who leaves (`… | head`) stops no robot and changes no exit code."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Collection, Iterable, Sequence

from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from dualbrain.core.text import HIDDEN_CHARACTERS

MIN_COLUMN_WIDTH = 24
"""Characters to which a column that gives way shrinks."""


class StderrConsole(Console):
    """A console for stderr that falls silent when nobody reads it any more; the usual one ends the program."""

    def __init__(self) -> None:
        """Plain text on stderr."""
        super().__init__(file=sys.stderr, highlight=False)

    def on_broken_pipe(self) -> None:
        """Be quiet from now on."""
        self.quiet = True


def print_result(text: str) -> None:
    """Print the result on stdout; where nobody reads it, stdout becomes the null device."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        redirect_stdout_to_null()


def print_table(heads: Sequence[str], rows: Iterable[Sequence[str]], *, wrap_columns: Collection[str] = ()) -> None:
    """Print rows on stdout as `columns` puts them."""
    print_result(format_table(heads, rows, wrap_columns=wrap_columns))


def format_table(heads: Sequence[str], rows: Iterable[Sequence[str]], *, wrap_columns: Collection[str] = ()) -> str:
    """Rows below their `heads`, each cell whole and on one line, so that names and ids can be copied.

    Where the screen is too narrow, the columns in `gives` wrap; where that is not enough, lines grow longer than the
    screen. A cell is text, never markup, and what would steer a terminal is shown as U+FFFD.
    """
    shown = [[sanitize_line(cell) for cell in row] for row in rows]
    table = Table(box=None, pad_edge=False)
    for head, *cells in zip(heads, *shown, strict=True):
        longest = max(map(cell_len, (head, *cells)))
        least = min(longest, MIN_COLUMN_WIDTH) if head in wrap_columns else longest
        table.add_column(head, min_width=least, overflow="fold")
    for row in shown:
        table.add_row(*map(Text, row))
    console = Console(highlight=False)
    with console.capture() as printed:
        console.print(table, crop=False, overflow="ignore")
    return printed.get().rstrip("\n")


def sanitize_line(text: str) -> str:
    """`text` on one line, with what would steer a terminal or hide words shown as U+FFFD."""
    return re.sub(f"[{HIDDEN_CHARACTERS}]", "\N{REPLACEMENT CHARACTER}", text)


def redirect_stdout_to_null() -> None:
    """Let stdout lead nowhere, so that what is still buffered does no harm at the end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
