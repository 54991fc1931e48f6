"""The named colours of scene objects."""

from __future__ import annotations

from dualbrain.errors import UnknownNameError

COLOUR_RGBA: dict[str, tuple[float, float, float, float]] = {
    "red": (0.80, 0.13, 0.12, 1),
    "blue": (0.13, 0.34, 0.70, 1),
    "green": (0.24, 0.56, 0.33, 1),
    "yellow": (0.93, 0.73, 0.16, 1),
    "orange": (0.91, 0.47, 0.15, 1),
    "purple": (0.46, 0.29, 0.60, 1),
    "teal": (0.12, 0.54, 0.55, 1),
    "white": (0.93, 0.92, 0.89, 1),
    "brown": (0.45, 0.30, 0.20, 1),
    "grey": (0.52, 0.55, 0.58, 1),
    "pink": (0.87, 0.52, 0.60, 1),
    "black": (0.16, 0.17, 0.19, 1),
    "clear": (0.72, 0.88, 0.95, 0.42),
    "oak": (0.62, 0.47, 0.32, 1),
    "skin": (0.87, 0.67, 0.55, 1),
    "sleeve": (0.26, 0.36, 0.47, 1),
}


def colour_rgba(name: str) -> tuple[float, float, float, float]:
    """Red, green, blue and opacity in [0, 1] of a named colour; raises `UnknownNameError`."""
    if name not in COLOUR_RGBA:
        raise UnknownNameError("colour", name, tuple(COLOUR_RGBA))
    return COLOUR_RGBA[name]
