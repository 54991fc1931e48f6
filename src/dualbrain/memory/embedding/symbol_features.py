"""Symbolic scene descriptors: the symbols of a scene summary as a unit vector.

A sentence encoder gives almost the same vector to `neighbour_across tall <3cm` and `neighbour_along low 3-6cm`, but the
right contract depends on the difference.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from dualbrain.core.encoder import Float32Array
from dualbrain.memory.embedding.hashing_encoder import hash_bin

SYMBOLS_DIM = 128
"""Number of hash bins."""
SYMBOLS_VERSION = "symbols-1"
NAMED_OBJECT_WEIGHT = 3.0
"""Factor for the symbols of an object that the instruction names."""

IGNORED_SYMBOLS = ("", "object")
"""Symbols without information, because every object has them."""


def symbol_features(instruction: str, summary: str) -> Float32Array | None:
    """Unit vector of shape (128,): hashed signed counts of the summary's symbols; None if it has no symbols.

    A symbol is one comma-separated attribute of a line, without the name of the object, so that scenes with other names
    and the same neighbours, paths and people are similar. The lines of objects that the instruction names count
    `NAMED_OBJECT_WEIGHT` times.
    """
    row = np.zeros(SYMBOLS_DIM)
    for symbol, weight in _weighted_symbols(instruction, summary):
        column, sign = hash_bin(symbol, SYMBOLS_DIM)
        row[column] += sign * weight
    length = float(np.linalg.norm(row))
    return (row / length).astype(np.float32) if length > 0.0 else None


def _weighted_symbols(instruction: str, summary: str) -> Iterator[tuple[str, float]]:
    words = set(re.findall(r"[^\W_]+", instruction.lower()))
    for line in summary.splitlines():
        name, _, rest = line.partition(":")
        named = bool(rest) and set(re.findall(r"[^\W_]+", name.lower())) <= words
        for symbol in (rest or name).split(","):
            if symbol.strip() not in IGNORED_SYMBOLS:
                yield symbol.strip().lower(), NAMED_OBJECT_WEIGHT if named else 1.0
