"""What people and programs are told: a reader who leaves (`… | head`) stops no robot and changes no exit code."""

from __future__ import annotations

import os
import sys

from rich.console import Console


class Account(Console):
    """A console for stderr that falls silent when nobody reads it any more; the usual one ends the program."""

    def __init__(self) -> None:
        """Plain text on stderr."""
        super().__init__(file=sys.stderr, highlight=False)

    def on_broken_pipe(self) -> None:
        """Be quiet from now on."""
        self.quiet = True


def answer(text: str) -> None:
    """Print the result on stdout; where nobody reads it, stdout becomes the null device."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        abandon_stdout()


def abandon_stdout() -> None:
    """Let stdout lead nowhere, so that what is still buffered does no harm at the end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
