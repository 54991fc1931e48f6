"""Symbolic scene descriptors: the words of a scene summary as a unit vector, sharp where sentence encoders blur.

A sentence encoder hardly tells `neighbour_across tall <3cm` from `neighbour_along low 3-6cm`; a contract hangs on it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from dualbrain.memory.embedding.hashing_encoder import hash_bin
from dualbrain.memory.embedding.text_encoder import Float32Array

SYMBOLS_DIM = 128
"""Bins."""
SYMBOLS_VERSION = "symbols-1"
NAMED_OBJECT_WEIGHT = 3.0
"""How much more the symbols of a thing count that the instruction names."""

IGNORED_SYMBOLS = ("", "object")
"""Says nothing: every thing has it."""


def symbol_features(instruction: str, summary: str) -> Float32Array | None:
    """Unit vector of shape (128,): hashed signed counts of the summary's symbols; None if it has none.

    A symbol is one comma-separated attribute of a line, without the name of the thing, so that a scene with other names
    and the same neighbours, ways and people is alike. Lines of things that the instruction names count `FOCUS` times.
    """
    row = np.zeros(SYMBOLS_DIM)
    for symbol, weight in _weighted_symbols(instruction, summary):
        place, sign = hash_bin(symbol, SYMBOLS_DIM)
        row[place] += sign * weight
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
