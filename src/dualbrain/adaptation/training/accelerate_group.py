"""A process group of the processes that a launcher started (`torchrun`, `accelerate launch`), on one or more hosts."""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import Any, TypeVar

import torch
from accelerate import PartialState
from accelerate.utils import broadcast_object_list, reduce
from torch import Tensor

from dualbrain.errors import DualbrainError

T = TypeVar("T")
BROADCAST_TIMEOUT = timedelta(days=1)
"""Longest wait for the first process, which alone computes the reference states and evaluates held-out questions."""


class FirstProcessError(DualbrainError):
    """The first process of a group failed in a computation that all processes wait for."""

    def __init__(self, reason: str) -> None:
        """Report the error message of the first process."""
        self.reason = reason
        super().__init__(f"the first process failed: {reason}")


class AccelerateGroup:
    """A process group with accelerate: NCCL between CUDA devices, gloo between CPUs."""

    def __init__(self, state: PartialState) -> None:
        """Use the processes that `state` has joined."""
        self.rank, self.size = state.process_index, state.num_processes

    def all_reduce_sum(self, tensors: Sequence[Tensor]) -> None:
        """Replace each tensor by its sum over the processes, in one transfer."""
        total: Any = reduce(torch.cat([tensor.flatten() for tensor in tensors]), reduction="sum")
        for tensor, part in zip(tensors, total.split([tensor.numel() for tensor in tensors]), strict=True):
            tensor.copy_(part.view_as(tensor))

    def run_on_first(self, work: Callable[[], T]) -> T:
        """The result of `work` in the first process; the others raise `FirstProcessError` if it fails there."""
        if self.rank == 0:
            try:
                result: Any = work()
            except Exception as error:
                broadcast_object_list([None, str(error) or type(error).__name__])
                raise
            broadcast_object_list([result, ""])
            return result
        result, why = broadcast_object_list([None, ""])
        if why:
            raise FirstProcessError(why)
        return result


@contextmanager
def join_process_group() -> Generator[AccelerateGroup]:
    """Join the processes of the launcher by its environment variables; each uses its own CUDA device.

    If one of them ends with an error, the launcher ends the others.
    """
    state = PartialState(cpu=not torch.cuda.is_available(), timeout=BROADCAST_TIMEOUT)
    yield AccelerateGroup(state)
    state.destroy_process_group()
