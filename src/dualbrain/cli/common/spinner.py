"""A sign of life while the planner thinks: a spinner and the time that has passed, on stderr."""

from __future__ import annotations

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn


class Spinner:
    """Shown from `start` to `stop`; both may be called again."""

    def __init__(self, console: Console, text: str) -> None:
        """Say `text` beside the spinner."""
        self._console, self._text = console, text
        self._progress: Progress | None = None

    def start(self) -> None:
        """Begin to wait."""
        if self._progress is None:
            columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
            self._progress = Progress(*columns, console=self._console, transient=True)
            self._progress.add_task(self._text, total=None)
            self._progress.start()

    def stop(self) -> None:
        """The wait is over."""
        if self._progress is not None:
            self._progress.stop()
            self._progress = None
