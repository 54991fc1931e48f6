"""Reads the lines of the shell: with editing and history while nothing moves, without waiting while something does."""

from __future__ import annotations

import os
import select
import sys
from contextlib import suppress

PROMPT = "dualbrain> "
READ_SIZE = 65536


class LineReader:
    """Lines of standard input, and a signal by which another thread ends a wait for one."""

    def __init__(self) -> None:
        """Read standard input, a terminal or not."""
        self._input, self.is_terminal = sys.stdin.fileno(), sys.stdin.isatty()
        self._rest, self._ended = b"", False
        self._wake_read, self._wake_write = os.pipe()
        os.set_blocking(self._wake_read, False)
        if self.is_terminal:
            with suppress(ImportError):  # line editing and history of `input`
                import readline  # noqa: F401

    def wake(self) -> None:
        """End the present or next `wait`, from any thread."""
        with suppress(OSError):  # the reader is closed
            os.write(self._wake_write, b"!")

    def show_prompt(self) -> None:
        """Print the prompt on a terminal before anything is loaded; a line may be typed at once."""
        if self.is_terminal:
            print(PROMPT, end="", flush=True)

    def prompt(self) -> str | None:
        """The next line, edited after a prompt on a terminal; None at the end of the input."""
        if not self.is_terminal:
            line = self._take_line()
            while line is None and not self._ended:
                self._read()
                line = self._take_line()
            return line
        if (line := self._take_line()) is not None:
            return line
        try:
            return input(PROMPT)
        except EOFError:
            return None

    def wait(self) -> str | None:
        """A line that arrives before `wake`, without a prompt; None if there is none."""
        while (line := self._take_line()) is None:
            inputs = [self._wake_read] if self._ended else [self._input, self._wake_read]
            ready, _, _ = select.select(inputs, [], [])
            if self._input in ready and not self._ended:
                self._read()
            if self._wake_read in ready:
                self._clear_wake()
                return self._take_line()
        return line

    @property
    def ended(self) -> bool:
        """Whether the input has ended and every line was returned."""
        return self._ended and not self._rest

    def close(self) -> None:
        """Close the signal."""
        os.close(self._wake_read)
        os.close(self._wake_write)

    def _read(self) -> None:
        data = os.read(self._input, READ_SIZE)
        self._rest += data
        if not data:
            self._ended = True
            self._rest += b"" if self._rest.endswith(b"\n") or not self._rest else b"\n"

    def _take_line(self) -> str | None:
        line, newline, rest = self._rest.partition(b"\n")
        if not newline:
            return None
        self._rest = rest
        return line.decode("utf-8", "replace")

    def _clear_wake(self) -> None:
        with suppress(BlockingIOError):
            while os.read(self._wake_read, READ_SIZE):
                pass
