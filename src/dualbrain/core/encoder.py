"""Interface of a sentence encoder; memory and knowledge receive one, because neither package imports the other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Float32Array = NDArray[np.float32]


class Encoder(Protocol):
    """Maps texts to unit vectors whose cosine is their semantic similarity."""

    @property
    def id(self) -> str:
        """Name and version of the model."""
        ...

    @property
    def dim(self) -> int:
        """Number of components of each vector."""
        ...

    def encode(self, texts: Sequence[str]) -> Float32Array:
        """One unit vector per text, (n_texts, dim), float32."""
        ...
