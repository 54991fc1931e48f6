"""The processes of one training run, on several devices or hosts; usually a single one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeVar

T = TypeVar("T")


class ProcessGroup(Protocol):
    """Rank and size of the group, and its collective operations.

    All processes must call the same operations in the same order; otherwise the others wait.
    """

    @property
    def rank(self) -> int:
        """The number of this process, from 0."""
        ...

    @property
    def size(self) -> int:
        """The number of processes."""
        ...

    def all_reduce_sum(self, tensors: Sequence[Any]) -> None:
        """Replace each tensor by its sum over the processes, equal to the bit in all of them."""
        ...

    def run_on_first(self, work: Callable[[], T]) -> T:
        """The result of `work` in the first process, sent to all; the others wait for it.

        An exception of `work` is raised in the first process; the others raise `FirstProcessError`.
        """
        ...


class SingleProcess:
    """A process group of one process."""

    rank, size = 0, 1

    def all_reduce_sum(self, tensors: Sequence[Any]) -> None:
        """Leave each tensor as it is."""

    def run_on_first(self, work: Callable[[], T]) -> T:
        """Run `work`."""
        return work()


SINGLE_PROCESS = SingleProcess()
