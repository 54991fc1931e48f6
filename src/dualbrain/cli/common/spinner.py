"""Spinner with elapsed time on stderr, for work of unknown duration; one line where stderr is not a terminal."""

from __future__ import annotations

from typing import Self

from rich.console import Console
from rich.markup import escape
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn


class Spinner:
    """A spinner on terminals, visible between `start` and `stop`; both may be called repeatedly.

    Without a terminal the first `start` prints the text as one line, so that no command begins with silence.
    """

    def __init__(self, console: Console, text: str) -> None:
        """Show `text` beside the spinner."""
        self._console, self._text = console, text
        self._announced = False
        self._progress: Progress | None = None

    def __enter__(self) -> Self:
        """Show the spinner."""
        self.start()
        return self

    def __exit__(self, *error: object) -> None:
        """Remove the spinner."""
        self.stop()

    def start(self) -> None:
        """Show the spinner, or print its text once."""
        if not self._console.is_terminal:
            if not self._announced:
                self._announced = True
                self._console.print(f"[dim]{escape(self._text)}[/]")
        elif self._progress is None:
            columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
            self._progress = Progress(*columns, console=self._console, transient=True)
            self._progress.add_task(self._text, total=None)
            self._progress.start()

    def stop(self) -> None:
        """Remove the spinner."""
        if self._progress is not None:
            self._progress.stop()
            self._progress = None
