"""The processes that carry out one fit together, on several devices or hosts; most often it is one alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeVar

T = TypeVar("T")


class ProcessGroup(Protocol):
    """Who am I, how many are we, and what we do as one.

    All call the same in the same order; who does not lets the others wait.
    """

    @property
    def rank(self) -> int:
        """Which of the processes this is, from 0."""
        ...

    @property
    def size(self) -> int:
        """How many there are."""
        ...

    def all_reduce_sum(self, tensors: Sequence[Any]) -> None:
        """Put into each tensor its sum over the processes: the same bits in all of them."""
        ...

    def run_on_first(self, work: Callable[[], T]) -> T:
        """What `work` gives in the first process, told to all; the others wait for it and do not do it.

        What it raises there it raises there; the others raise `FirstFailed`.
        """
        ...


class SingleProcess:
    """A fit in one process: nothing to share, nobody to tell."""

    rank, size = 0, 1

    def all_reduce_sum(self, tensors: Sequence[Any]) -> None:
        """Each is its own sum."""

    def run_on_first(self, work: Callable[[], T]) -> T:
        """Do it."""
        return work()


SINGLE_PROCESS = SingleProcess()
