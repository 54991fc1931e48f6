"""Which declarations of CSS hide text: each property with its threshold.

A value that is not understood counts as hiding if the property can hide. Two kinds of hiding are kept apart: an element
that is hidden with all that is in it (display, opacity, clipping, offsets), and text that is not seen in the style that
its element has (size, colour), while an element inside may have another style.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import cos, radians, sqrt
from typing import Any

from dualbrain.knowledge.readers.css_values import (
    ROOT_FONT_PX,
    WINDOW_PX,
    Colour,
    Rgb,
    Size,
    Tokens,
    blend,
    colour,
    colour_distance,
    degrees,
    keyword,
    length_px,
    number,
    significant,
    split_at,
)

Declarations = Mapping[str, Tokens]
"""The value of each property in effect, by its name in lower case."""

MIN_OPACITY = 0.1
MIN_FONT_PX = 4.0
MIN_BOX_PX = 2.0
"""An element that is lower or narrower is hidden, whether or not its content overflows."""
MIN_CLIPPED_PX = 6.0
MIN_CLIPPED_FONTS = 0.7
"""An element that is lower or narrower (in px, or in font sizes) and cuts off its content is hidden."""
MIN_COLOUR_DISTANCE = 0.08
MAX_NEGATIVE_PX, MAX_NEGATIVE_TOTAL_PX = 100.0, 500.0
"""Largest offset to the left or to the top, of one element and of nested ones together."""
MAX_RIGHT_PX, MAX_DOWN_PX = 1000.0, 3000.0
MAX_INDENT_PX = 200.0
MIN_SCALE = 0.25

BLACK, WHITE = Colour((0.0, 0.0, 0.0)), (1.0, 1.0, 1.0)
_GLOBAL = frozenset({"inherit", "initial", "unset", "revert", "revert-layer"})
_DISPLAYS = frozenset(
    [
        "block",
        "inline",
        "inline-block",
        "flex",
        "inline-flex",
        "grid",
        "inline-grid",
        "flow",
        "flow-root",
        "contents",
        "list-item",
        "run-in",
        "table",
        "inline-table",
        "table-row",
        "table-cell",
        "table-caption",
        "table-column",
        "table-column-group",
        "table-row-group",
        "table-header-group",
        "math",
        "ruby",
        "table-footer-group",
        "ruby-base",
        "ruby-text",
        "box",
    ]
)
_FONT_SIZES = {
    "xx-small": 9.0,
    "x-small": 10.0,
    "small": 13.0,
    "medium": 16.0,
    "large": 18.0,
    "x-large": 24.0,
    "xx-large": 32.0,
    "xxx-large": 48.0,
}
_SYSTEM_FONTS = frozenset({"caption", "icon", "menu", "message-box", "small-caption", "status-bar"})
_FILTERS = frozenset({"hue-rotate", "saturate", "sepia", "grayscale", "drop-shadow"})
_BLENDS = frozenset({"normal", "multiply", "darken", "color-burn", "overlay", "hard-light", "soft-light"})
_CUTS = ("hidden", "clip", "scroll", "auto")
_SIZE_KEYWORDS = frozenset(
    [
        "auto",
        "none",
        "fit-content",
        "min-content",
        "max-content",
        "stretch",
        "-webkit-fill-available",
        "-moz-available",
        "content",
        "-webkit-fit-content",
        "-moz-fit-content",
        "-webkit-max-content",
        "-moz-max-content",
        "-webkit-min-content",
    ]
)
_OFFSETS = {
    "left": "x",
    "right": "x",
    "top": "y",
    "bottom": "y",
    "margin-left": "x",
    "margin-right": "x",
    "margin-top": "y",
    "margin-bottom": "y",
    "inset-inline-start": "x",
    "inset-inline-end": "x",
    "inset-block-start": "y",
    "inset-block-end": "y",
    "margin-inline-start": "x",
    "margin-inline-end": "x",
    "margin-block-start": "y",
    "margin-block-end": "y",
}
_OFFSET_SHORTHANDS = ("inset", "inset-inline", "inset-block", "margin", "margin-inline", "margin-block")
_BOXES = (
    "height",
    "width",
    "max-height",
    "max-width",
    "block-size",
    "inline-size",
    "max-block-size",
    "max-inline-size",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class TextStyle:
    """Inherited by an element: size and colour of its text, the colours behind it, and effects of its ancestors."""

    font_px: float = ROOT_FONT_PX
    text: Colour = BLACK
    fill: Colour | None = None
    backgrounds: tuple[Rgb, ...] = (WHITE,)
    opacity: float = 1.0
    scale: float = 1.0
    offset_px: float = 0.0
    reason: str = ""
    """Why text in this style is not seen; "" if it is."""


def element_reason(declared: Declarations, style: TextStyle) -> str:
    """Why an element with `declared` values (and the computed `style`) is hidden with all it contains; "" if not."""
    if style.opacity < MIN_OPACITY:
        return "opacity"
    if style.offset_px < -MAX_NEGATIVE_TOTAL_PX:
        return "offset"
    for name, hides in _JUDGES.items():
        if (value := declared.get(name)) is not None and keyword(value) not in _GLOBAL and hides(value, style):
            return name
    return "overflow" if _cuts_off(declared, style) else ""


def computed_style(declared: Declarations, parent: TextStyle) -> TextStyle:
    """The style of an element with `declared` values inside one with the style `parent`."""
    font_px, unclear = _font_px(declared, parent.font_px)
    style = replace(parent, font_px=font_px, reason="")
    scale, known = _scale(declared)
    opacity = _opacity(declared)
    style = replace(
        style,
        opacity=parent.opacity * opacity,
        scale=parent.scale * scale,
        offset_px=parent.offset_px + min(0.0, _least_offset(declared, style)),
    )
    text, text_known = _text_colour(declared, "color", parent.text, style.text)
    style = replace(style, text=text)
    fill, fill_known = _text_colour(declared, "-webkit-text-fill-color", parent.fill, text)
    style = replace(style, fill=fill)
    style = replace(style, backgrounds=_backgrounds(declared, style))
    if unclear or not known:
        return replace(style, reason="size")
    if not (text_known and fill_known):
        return replace(style, reason="colour")
    return replace(style, reason=_text_reason(style))


def _text_reason(style: TextStyle) -> str:
    if style.font_px * style.scale < MIN_FONT_PX:
        return "size"
    shown = style.fill or style.text
    if shown.alpha * style.opacity < MIN_OPACITY:
        return "colour"
    nearest = min(colour_distance(blend(shown, below), below) for below in style.backgrounds)
    return "colour" if nearest < MIN_COLOUR_DISTANCE else ""


# --- size and colour of text ----------------------------------------------------------------------------------------


def _font_px(declared: Declarations, parent_px: float) -> tuple[float, bool]:
    """The font size [px], and whether it was not understood."""
    value = declared.get("font-size")
    if value is None:
        return parent_px, False
    word = keyword(value)
    if word in ("inherit", "unset", "revert", "revert-layer"):
        return parent_px, False
    if word in _FONT_SIZES or word == "initial" or word in _SYSTEM_FONTS:
        return _FONT_SIZES.get(word, 13.0 if word in _SYSTEM_FONTS else ROOT_FONT_PX), False
    if word in ("smaller", "larger", "math"):
        return parent_px * {"smaller": 1 / 1.2, "larger": 1.2, "math": 1.0}[word], False
    tokens = significant(value)
    found = length_px(tokens[0], Size(parent_px, parent_px)) if len(tokens) == 1 else None
    return (parent_px, True) if found is None else (found, False)


def _text_colour(declared: Declarations, name: str, inherited: Any, current: Colour) -> tuple[Any, bool]:
    """The colour that `name` declares, and whether it was understood."""
    value = declared.get(name)
    if value is None or keyword(value) in ("inherit", "unset", "revert", "revert-layer"):
        return inherited, True
    if keyword(value) == "initial":
        return (BLACK if name == "color" else None), True
    tokens = significant(value)
    found = colour(tokens[0], current) if len(tokens) == 1 else None
    return (inherited, False) if found is None else (found, True)


def _backgrounds(declared: Declarations, style: TextStyle) -> tuple[Rgb, ...]:
    """The colours that may be behind the text: declared ones, the stops of gradients, or the inherited ones."""
    found: list[Colour] = []
    image: list[Colour] = []
    for name in ("background", "background-color", "background-image"):
        for token in significant(declared.get(name, ())):
            if (one := colour(token, style.text)) is not None:
                found = [one]
            elif token.type == "function" and "gradient" in str(token.lower_name):
                stops = (colour(part, style.text) for part in significant(token.arguments))
                image += [stop for stop in stops if stop is not None]
    below = style.backgrounds
    if found:
        below = tuple(blend(found[0], one) for one in below)
    if image:
        below = tuple(blend(stop, one) for stop in image[:16] for one in below)
    return tuple(dict.fromkeys(below))[:16]


def _opacity(declared: Declarations) -> float:
    """The product of `opacity` and of the opacity filters; what is not understood is 0."""
    product = 1.0
    value = declared.get("opacity")
    if value is not None and keyword(value) not in _GLOBAL:
        tokens = significant(value)
        found = number(tokens[0]) if len(tokens) == 1 else None
        product = 0.0 if found is None else min(max(found, 0.0), 1.0)
    return product


# --- hiding of elements ---------------------------------------------------------------------------------------------


def _display(value: Tokens, _: TextStyle) -> bool:
    words = [str(token.lower_value) if token.type == "ident" else "" for token in significant(value)]
    return not words or any(word not in _DISPLAYS and not word.startswith("-") for word in words)


def _is_not(*words: str) -> Callable[[Tokens, TextStyle], bool]:
    return lambda value, _: keyword(value) not in words


def _filter(value: Tokens, _: TextStyle) -> bool:
    if keyword(value) == "none" or any(_is_legacy_filter(token) for token in value):
        return False
    return any(_filter_hides(token) for token in significant(value)) or not significant(value)


def _is_legacy_filter(token: Any) -> bool:
    """`progid:…`, which no browser has understood for ten years."""
    return token.type == "ident" and token.lower_value == "progid"


def _filter_hides(token: Any) -> bool:  # noqa: PLR0911  (a case for each function)
    if token.type != "function":
        return True
    arguments = significant(token.arguments)
    name = str(token.lower_name)
    if name in _FILTERS:
        return False
    amount = number(arguments[0]) if len(arguments) == 1 else 1.0 if not arguments else None
    match name:
        case "blur":
            radius = length_px(arguments[0], Size()) if len(arguments) == 1 else None
            return radius is None or radius > MIN_FONT_PX
        case "opacity":
            return amount is None or amount < MIN_OPACITY
        case "brightness" | "contrast":
            return amount is None or not 0.2 <= amount <= 5.0
        case "invert":
            return amount is None or 0.3 < amount < 0.7
        case "alpha":  # alpha(opacity=50), of old browsers
            values = [float(one.value) for one in arguments if one.type == "number"]
            return bool(values) and values[0] < 100.0 * MIN_OPACITY
        case _:
            return True


def _clip(value: Tokens, style: TextStyle) -> bool:
    if keyword(value) == "auto":
        return False
    tokens = significant(value)
    if len(tokens) != 1 or tokens[0].type != "function" or tokens[0].lower_name != "rect":
        return True
    edges = [token for token in significant(tokens[0].arguments) if token.type != "literal"]
    size = Size(style.font_px)
    found = [None if _is_word(edge, "auto") else length_px(edge, size) for edge in edges]
    if len(found) != 4 or any(
        one is None and not _is_word(edge, "auto") for one, edge in zip(found, edges, strict=True)
    ):
        return True
    top, right, bottom, left = found
    flat = bottom is not None and bottom - (top or 0.0) < MIN_CLIPPED_PX
    return flat or (right is not None and right - (left or 0.0) < MIN_CLIPPED_PX)


def _is_word(token: Any, word: str) -> bool:
    return token.type == "ident" and token.lower_value == word


def _clip_path(value: Tokens, style: TextStyle) -> bool:
    words = ("none", "border-box", "padding-box", "content-box", "margin-box", "fill-box", "stroke-box", "view-box")
    shapes = [token for token in significant(value) if not (token.type == "ident" and token.lower_value in words)]
    return any(_shape_hides(shape, Size(style.font_px, 100.0)) for shape in shapes)


def _shape_hides(shape: Any, size: Size) -> bool:
    """Whether a basic shape shows (almost) nothing of a box of 100 px."""
    if shape.type != "function":
        return True
    arguments = significant(shape.arguments)
    match str(shape.lower_name):
        case "inset":
            ends = next((k for k, token in enumerate(arguments) if _is_word(token, "round")), len(arguments))
            cuts = [length_px(token, size) for token in arguments[:ends]]
            known = [cut for cut in cuts if cut is not None]
            if not known or len(known) != len(cuts) or len(known) > 4:
                return True
            top, right, bottom, left = _four_sides(known)
            return top + bottom > 90.0 or left + right > 90.0
        case "circle" | "ellipse":
            ends = next((k for k, token in enumerate(arguments) if _is_word(token, "at")), len(arguments))
            radii = [length_px(token, size) for token in arguments[:ends] if token.type != "ident"]
            return (ends < len(arguments) and _far(arguments[ends + 1 :], size)) or any(
                r is None or r < 5.0 for r in radii
            )
        case "polygon":
            return _polygon_area(shape.arguments, size) < 100.0
        case _:
            return True


def _far(position: Tokens, size: Size) -> bool:
    values = [length_px(token, size) for token in position if token.type != "ident"]
    return any(value is None or not -50.0 <= value <= 1000.0 for value in values)


def _polygon_area(arguments: Tokens, size: Size) -> float:
    """Area of the polygon [px²], 0 if it is not understood (shoelace formula)."""
    corners: list[tuple[float, float]] = []
    for part in split_at(arguments, ","):
        values = [length_px(token, size) for token in significant(part) if token.type != "ident"]
        if len(values) == 2 and values[0] is not None and values[1] is not None:
            corners.append((min(max(values[0], 0.0), 100.0), min(max(values[1], 0.0), 100.0)))
        elif values:
            return 0.0
    pairs = zip(corners, [*corners[1:], *corners[:1]], strict=True)
    return abs(sum(a[0] * b[1] - b[0] * a[1] for a, b in pairs)) / 2.0


def _four_sides(values: list[float]) -> tuple[float, float, float, float]:
    """Top, right, bottom and left of one to four values."""
    top = values[0]
    right = values[1] if len(values) > 1 else top
    bottom = values[2] if len(values) > 2 else top
    return top, right, bottom, values[3] if len(values) > 3 else right


def _z_index(value: Tokens, _: TextStyle) -> bool:
    tokens = significant(value)
    if keyword(value) == "auto":
        return False
    found = number(tokens[0]) if len(tokens) == 1 else None
    return found is None or found < 0.0


def _indent(value: Tokens, style: TextStyle) -> bool:
    found = [length_px(token, Size(style.font_px, 1000.0)) for token in significant(value) if token.type != "ident"]
    return not found or any(one is None or abs(one) > MAX_INDENT_PX for one in found)


def _spacing(value: Tokens, style: TextStyle) -> bool:
    if keyword(value) == "normal":
        return False
    tokens = significant(value)
    found = length_px(tokens[0], Size(style.font_px, style.font_px)) if len(tokens) == 1 else None
    return found is None or not -0.4 * style.font_px < found < WINDOW_PX[0]


def _box(value: Tokens, style: TextStyle) -> bool:
    return _is_small(value, style, MIN_BOX_PX)


def _is_small(value: Tokens, style: TextStyle, least: float) -> bool:
    """Whether a size is below `least` [px]; sizes in percent refer to a box of 1000 px."""
    if keyword(value) in _SIZE_KEYWORDS:
        return False
    tokens = significant(value)
    if len(tokens) == 1 and tokens[0].type == "function" and str(tokens[0].lower_name) in _SIZE_KEYWORDS:
        return False
    found = length_px(tokens[0], Size(style.font_px, 1000.0)) if len(tokens) == 1 else None
    return found is None or found < least


def _cuts_off(declared: Declarations, style: TextStyle) -> bool:
    """Whether the element is too small for a line of text and cuts off what does not fit."""
    words = {
        str(token.lower_value)
        for name in ("overflow", "overflow-x", "overflow-y", "overflow-block", "overflow-inline")
        for token in significant(declared.get(name, ()))
        if token.type == "ident"
    }
    if not words.intersection(_CUTS):
        return False
    sizes = (*_BOXES, "line-height")
    return any(
        _is_small(declared[name], style, max(MIN_CLIPPED_PX, MIN_CLIPPED_FONTS * style.font_px))
        for name in sizes
        if name in declared and keyword(declared[name]) not in (*_GLOBAL, "normal") and not _is_factor(name, declared)
    )


def _is_factor(name: str, declared: Declarations) -> bool:
    """Whether a line height is a factor of the font size, and not almost 0."""
    tokens = significant(declared[name])
    return name == "line-height" and len(tokens) == 1 and tokens[0].type == "number" and float(tokens[0].value) > 0.3


# --- offsets and transformations ------------------------------------------------------------------------------------


def _offset(axis: str, whole: float = 1000.0) -> Callable[[Tokens, TextStyle], bool]:
    far = MAX_RIGHT_PX if axis == "x" else MAX_DOWN_PX

    def hides(value: Tokens, style: TextStyle) -> bool:
        return any(_is_off(token, style, far, whole) for token in significant(value)) or not significant(value)

    return hides


def _is_off(token: Any, style: TextStyle, far: float, whole: float) -> bool:
    if token.type == "ident":
        return str(token.lower_value) != "auto"
    found = length_px(token, Size(style.font_px, whole))
    if found is None:
        return True
    if token.type == "percentage":
        return not -100.0 < float(token.value) <= 100.0
    return found <= -MAX_NEGATIVE_PX or found >= far


def _least_offset(declared: Declarations, style: TextStyle) -> float:
    """The offset furthest to the left or to the top [px], 0 if none is negative."""
    found = [
        length_px(token, Size(style.font_px, 100.0))
        for name in (*_OFFSETS, *_OFFSET_SHORTHANDS, "text-indent")
        for token in significant(declared.get(name, ()))
        if token.type != "percentage"
    ]
    return min([0.0, *(one for one in found if one is not None)])


def _transform(value: Tokens, style: TextStyle) -> bool:
    if keyword(value) == "none":
        return False
    tokens = significant(value)
    return not tokens or any(_function_hides(token, style) for token in tokens)


def _function_hides(token: Any, style: TextStyle) -> bool:  # noqa: PLR0911  (a case for each function)
    if token.type != "function":
        return True
    arguments = [one for one in significant(token.arguments) if one.type != "literal"]
    name = str(token.lower_name)
    if name.startswith("translate"):
        return any(_is_off(one, style, MAX_RIGHT_PX, 100.0) for one in arguments) or not arguments
    if name.startswith("scale"):
        factors = [number(one) for one in arguments]
        return not factors or any(one is None or abs(one) < MIN_SCALE for one in factors[:2])
    if name in ("rotate", "rotatez"):
        return False
    if name in ("rotatex", "rotatey"):
        angle = degrees(arguments[0]) if len(arguments) == 1 else None
        return angle is None or cos(radians(angle)) < 0.2
    if name.startswith("skew"):
        angles = [degrees(one) for one in arguments]
        return any(one is None or abs(cos(radians(one))) < 0.2 for one in angles)
    return name != "perspective" and (name != "matrix" or _matrix_hides(arguments))


def _matrix_hides(arguments: Tokens) -> bool:
    values = [number(one) for one in arguments]
    known = [value for value in values if value is not None]
    if len(known) != 6 or len(values) != 6:
        return True
    a, b, c, d, e, f = known
    small = sqrt(abs(a * d - b * c)) < MIN_SCALE
    return small or min(e, f) <= -MAX_NEGATIVE_PX or e >= MAX_RIGHT_PX or f >= MAX_DOWN_PX


def _translate(value: Tokens, style: TextStyle) -> bool:
    if keyword(value) == "none":
        return False
    return any(_is_off(one, style, MAX_RIGHT_PX, 100.0) for one in significant(value))


def _scale(declared: Declarations) -> tuple[float, bool]:
    """The least scale of `scale`, `zoom` and `transform`, and whether they were understood."""
    least = 1.0
    for name in ("scale", "zoom"):
        value = declared.get(name)
        if value is None or keyword(value) in (*_GLOBAL, "none", "normal", "reset"):
            continue
        factors = [number(token) for token in significant(value)]
        if not factors or any(factor is None for factor in factors):
            return 1.0, False
        least *= min(1.0, *(abs(factor) for factor in factors if factor is not None))
    for token in significant(declared.get("transform", ())):
        if token.type == "function" and str(token.lower_name).startswith("scale"):
            factors = [number(one) for one in significant(token.arguments) if one.type != "literal"]
            least *= min([1.0, *(abs(factor) for factor in factors[:2] if factor is not None)])
    return least, True


_JUDGES: dict[str, Callable[[Tokens, TextStyle], bool]] = {
    "display": _display,
    "visibility": _is_not("visible"),
    "content-visibility": _is_not("visible", "auto"),
    "filter": _filter,
    "-webkit-filter": _filter,
    "mask": _is_not("none"),
    "mask-image": _is_not("none"),
    "-webkit-mask": _is_not("none"),
    "-webkit-mask-image": _is_not("none"),
    "mix-blend-mode": lambda value, _: keyword(value) not in _BLENDS,
    "-webkit-text-security": _is_not("none"),
    "unicode-bidi": _is_not("normal", "embed", "isolate", "plaintext"),
    "clip": _clip,
    "clip-path": _clip_path,
    "-webkit-clip-path": _clip_path,
    "z-index": _z_index,
    "text-indent": _indent,
    "letter-spacing": _spacing,
    "transform": _transform,
    "-webkit-transform": _transform,
    "-ms-transform": _transform,
    "translate": _translate,
    **dict.fromkeys(_BOXES, _box),
    **{name: _offset(axis) for name, axis in _OFFSETS.items()},
    **{name: _offset("x") for name in _OFFSET_SHORTHANDS},
}
"""The property that can hide an element, and whether a value of it does."""

TEXT_PROPERTIES = ("font-size", "font", "color", "-webkit-text-fill-color", "background", "background-color")
RELEVANT = frozenset(
    (
        *_JUDGES,
        *TEXT_PROPERTIES,
        *("background-image", "opacity", "scale", "zoom", "line-height"),
        *("overflow", "overflow-x", "overflow-y", "overflow-block", "overflow-inline"),
    )
)
"""The properties that can hide text; all others are ignored."""
