"""Spinner with elapsed time on stderr, for work of unknown duration; one line where stderr is not a terminal."""

from __future__ import annotations

from typing import Self

from rich.console import Console
from rich.markup import escape
from rich.progress import Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn


class Spinner:
    """A spinner on terminals, visible between `start` and `stop`; both may be called repeatedly.

    Without a terminal the first `start` prints the text as one line, so that no command begins with silence.
    """

    def __init__(self, console: Console, text: str) -> None:
        """Show `text` beside the spinner."""
        self._console, self._text = console, text
        self._announced = False
        self._progress: Progress | None = None
        self._task = TaskID(0)

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
            self._task = self._progress.add_task(escape(self._text), total=None)
            self._progress.start()

    def stop(self) -> None:
        """Remove the spinner."""
        if self._progress is not None:
            self._progress.stop()
            self._progress = None

    def add(self, text: str) -> None:
        """Show `text` after the text of the spinner, instead of an earlier addition; without a terminal as a line.

        May be called from any thread; has no effect on a terminal while the spinner is not visible.
        """
        words = f"{self._text}: {text}" if text else self._text
        if not self._console.is_terminal:
            self._console.print(f"[dim]{escape(words)}[/]")
        elif (progress := self._progress) is not None:
            progress.update(self._task, description=escape(words))
