"""The one parser of CSS values: lengths, numbers, angles and colours from the tokens of tinycss2.

Lengths are in px in a window of 1280 by 800. A value that is not understood is None, never a guess; what that means is
decided where the property is judged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from math import cos, isfinite, radians, sin
from typing import Any

from dualbrain.errors import MissingDependencyError

Tokens = Sequence[Any]
Rgb = tuple[float, float, float]

WINDOW_PX = (1280.0, 800.0)
"""Width and height of the window for which a page is judged."""
ROOT_FONT_PX = 16.0
MAX_NESTING = 16
"""Nesting of calc() and var() that is followed."""
_PX = {"px": 1.0, "pt": 4 / 3, "pc": 16.0, "in": 96.0, "cm": 96 / 2.54, "mm": 9.6 / 2.54, "q": 2.4 / 2.54}
_WINDOW_UNITS = {"vw": 0, "vi": 0, "vh": 1, "vb": 1}
_RADIANS = {"deg": 1.0, "grad": 0.9, "turn": 360.0, "rad": 57.29577951308232}
_SYSTEM_COLOURS: dict[str, Rgb] = {
    "canvas": (1.0, 1.0, 1.0),
    "field": (1.0, 1.0, 1.0),
    "buttonface": (0.94, 0.94, 0.94),
    "canvastext": (0.0, 0.0, 0.0),
    "fieldtext": (0.0, 0.0, 0.0),
    "buttontext": (0.0, 0.0, 0.0),
    "linktext": (0.0, 0.0, 0.93),
    "visitedtext": (0.33, 0.1, 0.55),
    "graytext": (0.43, 0.43, 0.43),
    "windowtext": (0.0, 0.0, 0.0),
    "window": (1.0, 1.0, 1.0),
}
_OKLAB_TO_LMS = ((0.3963377774, 0.2158037573), (-0.1055613458, -0.0638541728), (-0.0894841775, -1.2914855480))
_LMS_TO_RGB = (
    (4.0767416621, -3.3077115913, 0.2309699292),
    (-1.2684380046, 2.6097574011, -0.3413193965),
    (-0.0041960863, -0.7034186147, 1.7076147010),
)


@dataclass(frozen=True, slots=True)
class Size:
    """The sizes that relative units refer to: font size [px], and the length [px] that 100 % is."""

    font_px: float = ROOT_FONT_PX
    whole_px: float = WINDOW_PX[0]


@dataclass(frozen=True, slots=True)
class Colour:
    """A colour with components in [0, 1] and its opacity."""

    rgb: Rgb
    alpha: float = 1.0


def css_parser() -> Any:
    """The package tinycss2; raises `MissingDependencyError`."""
    return _import("tinycss2")


def _import(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        fix = "Install it with `pip install 'dualbrain[knowledge]'`."
        raise MissingDependencyError("The package tinycss2", fix=fix) from error


def significant(tokens: Tokens) -> list[Any]:
    """`tokens` without white space and comments."""
    return [token for token in tokens if token.type not in ("whitespace", "comment")]


def keyword(tokens: Tokens) -> str:
    """The keyword that `tokens` consist of, in lower case; "" for anything else."""
    found = significant(tokens)
    return str(found[0].lower_value) if len(found) == 1 and found[0].type == "ident" else ""


def split_at(tokens: Tokens, mark: str) -> list[list[Any]]:
    """`tokens` split at the literal `mark` (such as ",")."""
    parts: list[list[Any]] = [[]]
    for token in tokens:
        if token.type == "literal" and token.value == mark:
            parts.append([])
        else:
            parts[-1].append(token)
    return parts


def length_px(token: Any, size: Size) -> float | None:
    """The length of one token [px]; a percentage refers to `size.whole_px`, and a plain 0 is 0."""
    match token.type:
        case "number":
            value = float(token.value)
        case "percentage":
            value = float(token.value) * size.whole_px / 100.0
        case "dimension":
            unit = float_unit(str(token.lower_unit), size)
            value = float(token.value) * unit if unit is not None else None
        case "function":
            value = _calculated(token, size, 0)
        case _:
            return None
    return value if value is None or isfinite(value) else None


def float_unit(unit: str, size: Size) -> float | None:  # noqa: PLR0911  (a case for each unit)
    """One `unit` of length in px; None for an unknown one."""
    if unit in _PX:
        return _PX[unit]
    match unit:
        case "em":
            return size.font_px
        case "rem":
            return ROOT_FONT_PX
        case "ex" | "ch" | "cap":
            return 0.5 * size.font_px
        case "lh" | "ic":
            return 1.2 * size.font_px
        case "rex" | "rch" | "rlh" | "ric":
            return 0.5 * ROOT_FONT_PX
        case "vmin" | "vmax":
            return (min if unit == "vmin" else max)(WINDOW_PX) / 100.0
        case _:
            plain = unit[1:] if unit[:1] in ("s", "l", "d") and unit[1:] in _WINDOW_UNITS else unit
            return WINDOW_PX[_WINDOW_UNITS[plain]] / 100.0 if plain in _WINDOW_UNITS else None


def number(token: Any) -> float | None:
    """A number, or a percentage as a share of 1."""
    if token.type == "function":
        return _calculated(token, Size(whole_px=1.0), 0)
    if token.type not in ("number", "percentage"):
        return None
    value = float(token.value) / (100.0 if token.type == "percentage" else 1.0)
    return value if isfinite(value) else None


def degrees(token: Any) -> float | None:
    """An angle [degrees]."""
    if token.type == "number":
        return 0.0 if float(token.value) == 0.0 else None
    if token.type == "dimension" and token.lower_unit in _RADIANS:
        return float(token.value) * _RADIANS[token.lower_unit]
    return None


def _calculated(token: Any, size: Size, depth: int) -> float | None:
    """The value of calc(), min(), max() and clamp(); lengths in px, so that sums of different units are right."""
    name = str(token.lower_name)
    if depth > MAX_NESTING or name not in ("calc", "min", "max", "clamp", "-webkit-calc", "-moz-calc", "("):
        return None
    values = [_sum(part, size, depth + 1) for part in split_at(token.arguments, ",")]
    known = [value for value in values if value is not None]
    if len(known) != len(values) or not known:
        return None
    match name:
        case "min":
            return min(known)
        case "max":
            return max(known)
        case "clamp":
            return max(known[0], min(known[1], known[2])) if len(known) == 3 else None
        case _:
            return known[0] if len(known) == 1 else None


def _sum(tokens: Tokens, size: Size, depth: int) -> float | None:
    """A sum of products, from left to right with the usual precedence."""
    total, factor, sign, operator = 0.0, None, 1.0, ""
    for token in significant(tokens):
        if token.type == "literal" and token.value in "+-*/":
            if token.value in "+-" and factor is not None:
                total, factor, sign = total + sign * factor, None, 1.0 if token.value == "+" else -1.0
            operator = token.value
            continue
        value = _term(token, size, depth)
        if value is None:
            return None
        if factor is None:
            factor = value
        elif operator == "*":
            factor *= value
        elif operator == "/" and value:
            factor /= value
        else:
            return None
    return None if factor is None else total + sign * factor


def _term(token: Any, size: Size, depth: int) -> float | None:
    if depth > MAX_NESTING:
        return None
    if token.type == "() block":
        return _sum(token.content, size, depth + 1)
    return _calculated(token, size, depth + 1) if token.type == "function" else length_px(token, size)


def colour(token: Any, current: Colour) -> Colour | None:
    """The colour of one token; `current` is the colour of the text, for `currentcolor`."""
    if token.type == "ident" and token.lower_value in _SYSTEM_COLOURS:
        return Colour(_SYSTEM_COLOURS[token.lower_value])
    try:
        found = _import("tinycss2.color5").parse_color(token)
    except (ValueError, TypeError, ArithmeticError, NotImplementedError):
        return None
    if found is None:
        return None
    if isinstance(found, str):
        return current if found.lower() == "currentcolor" else None
    alpha = 1.0 if found.alpha is None else float(found.alpha)
    try:
        if found.space in ("oklab", "oklch"):
            rgb = _oklab_to_rgb(found.space, [float(value or 0.0) for value in found.coordinates])
        else:
            red, green, blue = (float(value or 0.0) for value in found.to("srgb").coordinates)
            rgb = (red, green, blue)
    except (NotImplementedError, ValueError, TypeError, ArithmeticError):
        return None
    bounded = [min(max(value, 0.0), 1.0) for value in rgb]
    return Colour((bounded[0], bounded[1], bounded[2]), min(max(alpha, 0.0), 1.0))


def _oklab_to_rgb(space: str, coordinates: list[float]) -> Rgb:
    """SRGB of a colour in OKLab (lightness, a, b) or OKLCh (lightness, chroma, hue [degrees])."""
    lightness, a, b = coordinates
    if space == "oklch":
        a, b = a * cos(radians(b)), a * sin(radians(b))
    lms = [(lightness + row[0] * a + row[1] * b) ** 3 for row in _OKLAB_TO_LMS]
    linear = [sum(factor * value for factor, value in zip(row, lms, strict=True)) for row in _LMS_TO_RGB]
    red, green, blue = (
        12.92 * value if value <= 0.0031308 else 1.055 * max(value, 0.0) ** (1 / 2.4) - 0.055 for value in linear
    )
    return red, green, blue


def colour_distance(one: Rgb, other: Rgb) -> float:
    """Distance of two colours: 0 for equal ones, 1 for black and white."""
    return (sum((a - b) ** 2 for a, b in zip(one, other, strict=True)) / 3.0) ** 0.5


def blend(top: Colour, below: Rgb) -> Rgb:
    """The colour that is seen where `top` covers `below`."""
    mixed = [top.alpha * a + (1.0 - top.alpha) * b for a, b in zip(top.rgb, below, strict=True)]
    return mixed[0], mixed[1], mixed[2]
