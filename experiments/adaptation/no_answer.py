"""What is no answer of a model's."""

from __future__ import annotations


class NoAnswerError(RuntimeError):
    """The engine broke or time ran out, which says nothing of the model: the unit is to be carried out again."""

    def __init__(self, finish: str, detail: str = "") -> None:
        """Say what came instead."""
        super().__init__(f"no answer: {finish} {detail}".rstrip())
