"""Output on stdout and stderr. A closed pipe (`… | head`) stops no robot and changes no exit code."""

from __future__ import annotations

import os
import sys
from collections.abc import Collection, Iterable, Sequence
from typing import IO, Any

from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from dualbrain.core.untrusted.visible_text import replace_hidden, visible_text

MIN_COLUMN_WIDTH = 24
"""Minimum width of a column that wraps [characters]."""


class VisibleConsole(Console):
    """A console in which no text can control the terminal or hide: see `visible_text`.

    It stops printing when the pipe is closed; the default one ends the program.
    """

    def on_broken_pipe(self) -> None:
        """Print nothing from now on."""
        self.quiet = True
        _redirect_to_null(self.file)

    def render_str(self, text: str, **options: Any) -> Text:
        """`text` with its markup, as the base class renders it, without hidden characters."""
        return super().render_str(visible_text(text, keep_lines=True), **options)


class StderrConsole(VisibleConsole):
    """A console for stderr."""

    def __init__(self) -> None:
        """Print plain text to stderr; a terminal wraps long lines by itself, and a file has them whole."""
        super().__init__(file=sys.stderr, highlight=False, soft_wrap=True)


def print_result(text: str) -> None:
    """Print a result on stdout, without hidden characters; if the pipe is closed, stdout becomes the null device."""
    try:
        print(visible_text(text, keep_lines=True), flush=True)
    except BrokenPipeError:
        redirect_stdout_to_null()


def print_message(text: str) -> None:
    """Print a message on stderr, without hidden characters; if that is impossible, stderr becomes the null device."""
    try:
        print(visible_text(text, keep_lines=True), file=sys.stderr, flush=True)
    except OSError:  # a closed pipe or terminal, a full disk
        _redirect_to_null(sys.stderr)


def print_table(heads: Sequence[str], rows: Iterable[Sequence[str]], *, wrap_columns: Collection[str] = ()) -> None:
    """Print a table on stdout; see `format_table`."""
    print_result(format_table(heads, rows, wrap_columns=wrap_columns))


def format_table(heads: Sequence[str], rows: Iterable[Sequence[str]], *, wrap_columns: Collection[str] = ()) -> str:
    """A table of `rows` below `heads`; each cell stays on one line, so that names and ids can be copied.

    If the terminal is too narrow, the columns in `wrap_columns` wrap; if that is not enough, lines become longer than
    the terminal is wide. A cell is text, never markup; control characters are shown as U+FFFD.
    """
    shown = [[sanitize_line(cell) for cell in row] for row in rows]
    table = Table(box=None, pad_edge=False)
    for head, *cells in zip(heads, *shown, strict=True):
        longest = max(map(cell_len, (head, *cells)))
        least = min(longest, MIN_COLUMN_WIDTH) if head in wrap_columns else longest
        table.add_column(head, min_width=least, overflow="fold")
    for row in shown:
        table.add_row(*map(Text, row))
    console = Console(highlight=False, force_terminal=False)  # plain text: escape sequences would be shown
    with console.capture() as printed:
        console.print(table, crop=False, overflow="ignore")
    return printed.get().rstrip("\n")


def sanitize_line(text: str) -> str:
    """`text` on one line; control characters and characters that hide text are shown as U+FFFD."""
    return replace_hidden(text)


def redirect_stdout_to_null() -> None:
    """Redirect stdout to the null device, so that flushing the buffer at exit does not fail."""
    _redirect_to_null(sys.stdout)


def _redirect_to_null(stream: IO[str]) -> None:
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, stream.fileno())
    os.close(null)
