"""What the index needs of a sentence encoder; one is handed in, because memory and knowledge do not know each other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Float32Array = NDArray[np.float32]


class Encoder(Protocol):
    """Turns texts into vectors whose cosine is their likeness in meaning; `id` names model and version."""

    @property
    def id(self) -> str:
        """Name and version."""
        ...

    @property
    def dim(self) -> int:
        """Length of each vector."""
        ...

    def encode(self, texts: Sequence[str]) -> Float32Array:
        """Unit rows of shape (n_texts, dim), float32."""
        ...
