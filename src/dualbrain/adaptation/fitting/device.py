"""Where torch computes, and that it computes the same every time; decided here and nowhere else."""

# pyright: reportMissingImports=false

from __future__ import annotations

import os

import torch


def settle(threads: int) -> torch.device:
    """The CUDA device of this process where torch sees one, else the processor, with `threads` threads.

    From now on only algorithms that give the same bits each time are used; cuBLAS has them with a work space of its
    own only, which must be asked for before its first use.
    """
    torch.set_num_threads(threads)
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    torch.use_deterministic_algorithms(mode=True)
    return torch.device("cuda", torch.cuda.current_device()) if torch.cuda.is_available() else torch.device("cpu")
