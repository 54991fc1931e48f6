"""The symbols of a scene summary that bear on one placement, as a vector of 0 and 1."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

HEIGHTS = ("low", "hand_high", "tall")
SYMBOLS = (
    "constant",
    "tight",
    *(f"{height} neighbour on the {axis} axis" for axis in ("free", "other") for height in HEIGHTS),
    *(f"neighbour within 3 cm on the {axis} axis" for axis in ("free", "other")),
    *(f"{height} object on the path" for height in HEIGHTS),
    "overhead",
    "overhead above the object",
    "overhead above the end",
    "near the edge",
    "fragile",
    "person near",
    "person crossing",
    "to a place",
)
"""Names of the symbols in the order of the vector."""

SINGLE_WORDS = {
    "overhead over_path": "overhead",
    "over_object": "overhead above the object",
    "over_end": "overhead above the end",
    "near_edge": "near the edge",
    "fragile": "fragile",
    "tight": "tight",
}
"""Words of a summary that are a symbol by themselves."""


class Placement(NamedTuple):
    """One placement: a scene summary, the object that is carried, and its destination."""

    summary: str
    object_name: str
    destination: str


def symbol_vector(placement: Placement) -> Array:
    """The symbols (n,) of `placement`, in the order of `SYMBOLS`; an object that is not in the summary has none."""
    words, person = _words(placement.summary, placement.object_name), _words(placement.summary, "person")
    found = {"constant", *(["to a place"] if not _is_container(placement) else [])}
    found |= _neighbour_symbols(words)
    found |= {f"{height} object on the path" for height in HEIGHTS if f"path_max_height {height}" in _path(placement)}
    found |= {name for word, name in SINGLE_WORDS.items() if word in words}
    found |= {f"person {state}" for state in ("near", "crossing") if state in person}
    return np.array([float(name in found) for name in SYMBOLS])


def stated_value(placement: Placement, word: str) -> str:
    """The value after `word` in the line of the object, for the path to the destination; "" if it is not stated."""
    for words in (_path(placement), _words(placement.summary, placement.object_name)):
        for one in words:
            name, _, value = one.partition(" ")
            if name == word:
                return value
    return ""


def _neighbour_symbols(words: Sequence[str]) -> set[str]:
    """The symbols of the neighbours, by the free and the other finger axis."""
    free = "across" if "free_finger_axis across" in words else "along"
    found: set[str] = set()
    for axis, name in (("free", free), ("other", "along" if free == "across" else "across")):
        for one in words:
            kind, _, description = one.partition(" ")
            height, _, gap = description.partition(" ")
            if kind == f"neighbour_{name}":
                found.add(f"{height} neighbour on the {axis} axis")
                found |= {f"neighbour within 3 cm on the {axis} axis"} if gap == "<3cm" else set()
    return found


def _words(summary: str, name: str) -> list[str]:
    """The comma-separated words in the line of `name`; none if there is no such line."""
    line = next((line[len(name) + 2 :] for line in summary.splitlines() if line.startswith(f"{name}: ")), "")
    return line.split(", ")


def _is_container(placement: Placement) -> bool:
    return _words(placement.summary, placement.destination)[0] == "container"


def _path(placement: Placement) -> list[str]:
    """The words of the path to the destination: a line describes one path per container, in the order of the lines."""
    containers = [
        name
        for line in placement.summary.splitlines()
        for name, _, rest in [line.partition(": ")]
        if rest.split(", ")[0] == "container"
    ]
    paths: list[list[str]] = []
    for word in _words(placement.summary, placement.object_name):
        if word.startswith("path_max_height "):
            paths.append([])
        if paths:
            paths[-1].append(word)
    at = containers.index(placement.destination) if placement.destination in containers else 0
    return paths[at] if at < len(paths) else []
