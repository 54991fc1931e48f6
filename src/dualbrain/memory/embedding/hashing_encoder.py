"""Sentence encoder without weights: hashed words. It compares spelling, not meaning; for tests and dry runs."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.encoder import Float32Array


class HashingEncoder:
    """Counts of words and letter triples, hashed into `dim` signed bins and normalised (Weinberger et al. 2009).

    The result is the same on every machine. Texts that share words are similar; synonyms are not.
    """

    def __init__(self, dim: int = 64) -> None:
        """Create an encoder with vectors of length `dim`."""
        self.dim = dim
        self.id = f"hashing@{dim}"

    def encode(self, texts: Sequence[str]) -> Float32Array:
        """Unit rows of shape (n_texts, dim), float32."""
        return np.stack([self._encode_one(text) for text in texts]) if texts else np.empty((0, self.dim), np.float32)

    def _encode_one(self, text: str) -> NDArray[np.float32]:
        row = np.zeros(self.dim)
        for token, count in _weighted_tokens(text):
            column, sign = hash_bin(token, self.dim)
            row[column] += sign * count
        return (row / np.linalg.norm(row)).astype(np.float32) if row.any() else np.eye(1, self.dim, dtype=np.float32)[0]


def hash_bin(token: str, dim: int) -> tuple[int, float]:
    """The bin of `token` among `dim` bins, and its sign; the same on every machine."""
    code = int.from_bytes(hashlib.blake2b(token.encode("utf-8", "replace"), digest_size=8).digest(), "little")
    return (code >> 1) % dim, 1.0 if code & 1 else -1.0


def _weighted_tokens(text: str) -> Iterator[tuple[str, float]]:
    for word in text.lower().split():
        yield word, 1.0
        padded = f"<{word}>"
        for start in range(len(padded) - 2):
            yield padded[start : start + 3], 0.3
