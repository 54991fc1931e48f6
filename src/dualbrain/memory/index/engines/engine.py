"""Interface of a vector engine."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.encoder import Float32Array
from dualbrain.errors import DualbrainError

Numbers = NDArray[np.int64]


RETRY_INTERVAL_S = 10.0
"""After a failed connection, no other is tried for this time [s], so that retrieval does not wait for the network."""


class EngineUnreachableError(DualbrainError):
    """The engine does not answer; the vectors are read from the ledger instead."""


class EngineRefusalError(EngineUnreachableError):
    """The engine answers and refuses, for example for want of a permission; a repetition does not help."""


class VectorEngine(Protocol):
    """Vectors by the number of their episode event, each in one group; an engine is a projection of the ledger.

    Its answers select candidates only, so a wrong vector in an engine can hide a memory but cannot change a score.
    Every method raises `EngineUnreachableError` if the engine does not answer, `EngineRefusalError` if it refuses.
    """

    max_count: int
    """Largest number of vectors that one search can return."""

    def stored(self) -> tuple[Numbers, Numbers]:
        """Event numbers and groups of all vectors, each of shape (n,)."""
        ...

    def add(self, seqs: Numbers, groups: Numbers, vectors: Float32Array) -> None:
        """Add vectors of shape (n, dim); one that is stored already may be replaced by its equal."""
        ...

    def nearest(self, group: int, vector: Float32Array, count: int) -> tuple[Numbers, Float32Array]:
        """Event numbers and inner products of the `count` vectors of a group with the largest product, largest first.

        The search is exact up to rounding. Fewer are returned only if the group has fewer.
        """
        ...

    def close(self) -> None:
        """Close the connection."""
        ...
