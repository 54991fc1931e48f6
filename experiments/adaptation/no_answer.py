"""The error of a request without an answer."""

from __future__ import annotations


class NoAnswerError(RuntimeError):
    """The engine failed or time ran out, which is no evidence about the model: the unit must be run again."""

    def __init__(self, finish_reason: str, detail: str = "") -> None:
        """Report the finish reason, and a detail if there is one."""
        super().__init__(f"no answer: {finish_reason} {detail}".rstrip())
