"""A team of the processes that a launcher started (`torchrun`, `accelerate launch`), on one host or several."""

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
"""How long the others wait for the first one, which alone computes the base's states and asks what is held out."""


class FirstProcessError(DualbrainError):
    """The first process of a team could not do what all wait for."""

    def __init__(self, reason: str) -> None:
        """Say what it said."""
        self.reason = reason
        super().__init__(f"the first process failed: {reason}")


class AccelerateGroup:
    """A team over accelerate: NCCL between CUDA devices, gloo between processors."""

    def __init__(self, state: PartialState) -> None:
        """Take the processes that `state` has joined."""
        self.rank, self.size = state.process_index, state.num_processes

    def all_reduce_sum(self, tensors: Sequence[Tensor]) -> None:
        """Put into each tensor its sum over the processes; all of them travel as one."""
        told: Any = reduce(torch.cat([tensor.flatten() for tensor in tensors]), reduction="sum")
        for tensor, part in zip(tensors, told.split([tensor.numel() for tensor in tensors]), strict=True):
            tensor.copy_(part.view_as(tensor))

    def run_on_first(self, work: Callable[[], T]) -> T:
        """What `work` gives in the first process; raises `FirstFailed` in the others if it raises there."""
        if self.rank == 0:
            try:
                done: Any = work()
            except Exception as error:
                broadcast_object_list([None, str(error) or type(error).__name__])
                raise
            broadcast_object_list([done, ""])
            return done
        done, why = broadcast_object_list([None, ""])
        if why:
            raise FirstProcessError(why)
        return done


@contextmanager
def join_process_group() -> Generator[AccelerateGroup]:
    """Join the processes that the launcher started, by the variables that it set; each takes its own CUDA device.

    If one of them ends with an error the launcher ends the others.
    """
    state = PartialState(cpu=not torch.cuda.is_available(), timeout=BROADCAST_TIMEOUT)
    yield AccelerateGroup(state)
    state.destroy_process_group()
