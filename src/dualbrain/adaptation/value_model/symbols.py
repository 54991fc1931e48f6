"""The symbols of a scene summary that bear on one placement, as a vector of 0 and 1."""

from __future__ import annotations

import re
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


class Placement(NamedTuple):
    """One placement: a scene summary, the object that is carried, and its destination."""

    summary: str
    object_name: str
    destination: str


def symbol_vector(placement: Placement) -> Array:
    """The symbols (n,) of `placement`, in the order of `SYMBOLS`; an object that is not in the summary has none."""
    line, person = _line(placement.summary, placement.object_name), _line(placement.summary, "person")
    free = "across" if "free_finger_axis across" in line else "along"
    found = {"constant", *(["to a place"] if not _is_container(placement) else [])}
    for axis, name in (("free", free), ("other", "along" if free == "across" else "across")):
        if match := re.search(rf"neighbour_{name} (\w+) (\S+?)(,|$)", line):
            found.add(f"{match[1]} neighbour on the {axis} axis")
            found |= {f"neighbour within 3 cm on the {axis} axis"} if match[2] == "<3cm" else set()
    if match := re.search(r"path_max_height (\w+)", _path(placement, line)):
        found.add(f"{match[1]} object on the path")
    words = {
        "overhead": "overhead",
        "over_object": "overhead above the object",
        "over_end": "overhead above the end",
        "near_edge": "near the edge",
        "fragile": "fragile",
        "tight": "tight",
    }
    found |= {name for word, name in words.items() if re.search(rf"\b{word}\b", line)}
    found |= {f"person {state}" for state in ("near", "crossing") if person == state}
    return np.array([float(name in found) for name in SYMBOLS])


def stated_value(placement: Placement, word: str) -> str:
    """The value after `word` in the line of the object, for the path to the destination; "" if it is not stated."""
    line = _line(placement.summary, placement.object_name)
    match = re.search(rf"\b{word} ([\w.]+)", _path(placement, line)) or re.search(rf"\b{word} ([\w.]+)", line)
    return match[1] if word and match else ""


def _line(summary: str, name: str) -> str:
    """The text after `name` in the line of this object; "" if there is none."""
    return next((line[len(name) + 2 :] for line in summary.splitlines() if line.startswith(f"{name}: ")), "")


def _is_container(placement: Placement) -> bool:
    return _line(placement.summary, placement.destination).startswith("container")


def _path(placement: Placement, line: str) -> str:
    """The symbols of the path to the destination: the summary lists one path per container in their order."""
    containers = re.findall(r"^(\w+): container", placement.summary, re.MULTILINE)
    paths = re.findall(r"path_max_height.*?(?=, path_max_height|$)", line)
    at = containers.index(placement.destination) if placement.destination in containers else 0
    return paths[at] if at < len(paths) else ""
