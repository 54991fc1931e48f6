"""Interface of a sentence encoder; memory and knowledge receive one, because neither package imports the other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Float32Array = NDArray[np.float32]


class Encoder(Protocol):
    """Maps texts to vectors whose cosine measures the similarity of their meaning.

    `id` names model and version: vectors of different ids are never compared. The vector of a text depends on this text
    alone, not on the texts that are encoded together with it.
    """

    @property
    def id(self) -> str:
        """Name and version, e.g. "minilm-l6-v2-int8@8199be6f"."""
        ...

    @property
    def dim(self) -> int:
        """Length of each vector."""
        ...

    def encode(self, texts: Sequence[str]) -> Float32Array:
        """Unit rows of shape (n_texts, dim), float32."""
        ...


class TokenEncoder(Protocol):
    """Maps a text to one vector for each of its tokens, in the context of the whole text."""

    @property
    def id(self) -> str:
        """Name and version, as of an `Encoder`."""
        ...

    def encode_tokens(self, text: str) -> tuple[Float32Array, tuple[tuple[int, int], ...]]:
        """Vectors of shape (tokens, dim), float32, and the beginning and end of each token in `text` [characters].

        Tokens that the encoder adds have the position (0, 0). A long text is cut.
        """
        ...
