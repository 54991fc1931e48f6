"""Filter for the visible text of a PDF page: tracks the graphics state and removes text that is not visible."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field
from math import sqrt
from typing import Any, cast

MIN_TEXT_HEIGHT_PT = 2.0
"""Text with a smaller height [pt] counts as hidden."""
MIN_WIDTH_SHARE = 0.1
"""Text that is scaled to a smaller share of its width counts as hidden."""
MAX_OVERLAP = 0.4
"""Text whose characters are moved back by a larger share of the font size counts as hidden."""
MIN_OPACITY = 0.1
"""Text with a smaller opacity counts as hidden."""
WHITE_THRESHOLD = 0.97
"""Text whose colour components are all at least this value counts as white."""
FILLING_MODES, STROKING_MODES = (0, 2, 4, 6), (1, 2, 5, 6)
"""Text rendering modes that fill and that stroke; the others (3, 7) show nothing (ISO 32000-1, 9.3.6)."""
TEXT_OPERATORS = (b"Tj", b"TJ", b"'", b'"')

Matrix = tuple[float, ...]
"""An affine map (a, b, c, d, e, f) of row vectors (ISO 32000-1, 8.3.4)."""
_IDENTITY: Matrix = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0)


@dataclass(slots=True, kw_only=True)
class _GraphicsState:
    """The part of the graphics state that determines the visibility of text."""

    mode: int = 0
    size: float = 12.0
    width: float = 1.0
    spacing: float = 0.0
    rise: float = 0.0
    spaces: dict[str, Any] = field(default_factory=dict[str, Any])
    white: frozenset[str] = frozenset()
    clear: frozenset[str] = frozenset()

    def hidden_reason(self) -> str:
        """The reason why text is invisible in this state; "" if it is visible."""
        used = ["fill"] * (self.mode in FILLING_MODES) + ["stroke"] * (self.mode in STROKING_MODES)
        reasons = {
            "invisible text": not used,
            "text without width": abs(self.width) < MIN_WIDTH_SHARE or self.spacing <= -MAX_OVERLAP * abs(self.size),
            "white text": self.white.issuperset(used),
            "transparent text": (self.white | self.clear).issuperset(used),
        }
        return next((reason for reason, holds in reasons.items() if holds), "")


@dataclass(slots=True, kw_only=True)
class _Stream:
    """The content of the page or of a form, with the resources that its names refer to.

    `placement` maps its space to that of the page, and `state` is the graphics state at its beginning. `content` states
    for each open marked content whether its layer is off, `is_off` whether the whole stream is in such a layer.
    """

    resources: Any
    state: _GraphicsState
    placement: Matrix = _IDENTITY
    is_off: bool = False
    stack: list[_GraphicsState] = field(default_factory=list[_GraphicsState])
    content: list[bool] = field(default_factory=list[bool])

    @property
    def is_hidden(self) -> bool:
        """Whether text at the present place of the stream is in a layer that is off."""
        return self.is_off or any(self.content)


class VisibleTextFilter:
    """Visits the operators of one page; invisible text is not extracted but added to `hidden`, by kind."""

    def __init__(self, page: Any, disabled: frozenset[int], hidden: dict[str, list[str]]) -> None:
        """Create a filter for `page`; `disabled` are the object numbers of the layers that are switched off."""
        self._hidden, self._disabled = hidden, disabled
        self._box = [float(value) for value in page.cropbox]
        self._state = _GraphicsState()
        self._streams = [_Stream(resources=_resolve(page, "/Resources"), state=self._state)]

    def visit_before(self, operator: bytes, operands: list[Any], cm: Sequence[float], tm: Sequence[float]) -> None:
        """Apply `operator` to the state; clear the operands of an operator that shows invisible text."""
        stream = self._streams[-1]
        match operator:
            case b"q":
                stream.stack.append(copy(self._state))
            case b"Q" if stream.stack:
                self._state = stream.stack.pop()
            case b"Do" if operands:
                self._streams.append(self._form(stream, str(operands[0]), cm))
            case b"BDC" | b"BMC":
                stream.content.append(self._in_hidden_layer(stream, operands))
            case b"EMC" if stream.content:
                stream.content.pop()
            case _ if operator in TEXT_OPERATORS and operands:
                self._filter_text(operator, operands, _multiply(tm, _multiply(cm, stream.placement)))
            case _:
                self._update_state(stream, operator, operands)

    def visit_after(self, operator: bytes, operands: list[Any], cm: Sequence[float], tm: Sequence[float]) -> None:
        """Restore the state after a form."""
        if operator == b"Do" and operands and len(self._streams) > 1:
            self._state = self._streams.pop().state

    def _form(self, outer: _Stream, name: str, cm: Sequence[float]) -> _Stream:
        """The stream of the form that `outer` calls `name`; an image has no operators."""
        form = _resolve(_resolve(outer.resources, "/XObject"), name)
        is_off = outer.is_hidden or ("/OC" in form and self._is_disabled(form.raw_get("/OC")))
        matrix = [_number(value) for value in _resolve(form, "/Matrix")] or _IDENTITY
        placement = _multiply(matrix, _multiply(cm, outer.placement))
        resources = _resolve(form, "/Resources")
        return _Stream(resources=resources, state=copy(self._state), placement=placement, is_off=is_off)

    def _update_state(self, stream: _Stream, operator: bytes, operands: list[Any]) -> None:
        """Apply an operator that sets the state; operands that are not numbers are ignored."""
        numbers = [float(value) for value in operands if isinstance(value, (int, float))]
        if operator == b"Tr" and numbers:
            self._state.mode = int(numbers[0])
        elif operator == b"Tf" and numbers:
            self._state.size = numbers[-1]
        elif operator in _TEXT_STATE and numbers:
            name, unit = _TEXT_STATE[operator]
            setattr(self._state, name, numbers[0] * unit)
        elif operator in _COLOUR_OPERATORS:
            self._set_colour(stream, operator, operands, numbers)
        elif operator == b"gs" and operands:
            self._set_opacity(_resolve(_resolve(stream.resources, "/ExtGState"), str(operands[0])))

    def _set_colour(self, stream: _Stream, operator: bytes, operands: list[Any], numbers: list[float]) -> None:
        paint, space = _COLOUR_OPERATORS[operator]
        if space == "chosen":
            space = operands[0] if operands else ""
            named = _resolve(stream.resources, "/ColorSpace")
            space = named[space].get_object() if space in named else space
            numbers = _initial_colour(space)
        self._state.spaces = self._state.spaces | ({paint: space} if space else {})
        is_white = _is_white(self._state.spaces.get(paint, "/DeviceGray"), numbers)
        self._state.white = self._state.white - {paint} | ({paint} if is_white else set())

    def _set_opacity(self, settings: Any) -> None:
        """Apply a graphics state parameter dictionary."""
        opacities = {"fill": "/ca", "stroke": "/CA"}
        # a mask other than /None: what it leaves is not known
        is_masked = "/SMask" in settings and not isinstance(settings["/SMask"], str)
        for paint in (paint for paint, key in opacities.items() if is_masked or key in settings):
            is_clear = is_masked or _number(settings[opacities[paint]]) < MIN_OPACITY
            self._state.clear = self._state.clear - {paint} | ({paint} if is_clear else set())
        if "/Font" in settings:
            self._state.size = _number(settings["/Font"][1])

    def _filter_text(self, operator: bytes, operands: list[Any], matrix: Matrix) -> None:
        if operator == b'"' and len(operands) > 2:
            self._state.spacing = _number(operands[1])
        a, b, c, d, e, f = _multiply((1.0, 0.0, 0.0, 1.0, 0.0, self._state.rise), matrix)
        scale = sqrt(abs(a * d - b * c))
        left, bottom, right, top = self._box
        on_page = left - 1.0 <= e <= right + 1.0 and bottom - 1.0 <= f <= top + 1.0
        reason = "a layer that is off" if self._streams[-1].is_hidden else self._state.hidden_reason()
        reason = reason or ("tiny text" if abs(self._state.size) * scale < MIN_TEXT_HEIGHT_PT else "")
        reason = reason or ("" if on_page else "text off the page")
        if reason:
            self._hidden.setdefault(reason, []).append(_operand_text(operands[-1]))
            operands[-1] = type(operands[-1])()

    def _in_hidden_layer(self, stream: _Stream, operands: list[Any]) -> bool:
        if len(operands) < 2 or str(operands[0]) != "/OC":
            return False
        layers = _resolve(stream.resources, "/Properties")
        return str(operands[1]) in layers and self._is_disabled(layers.raw_get(str(operands[1])))

    def _is_disabled(self, reference: Any) -> bool:
        """Whether a layer, or every layer of a membership dictionary, is switched off."""
        if getattr(reference, "idnum", None) in self._disabled:
            return True
        members: Any = _resolve(reference.get_object(), "/OCGs")
        numbers = [int(one.idnum) for one in members if hasattr(one, "idnum")]
        return bool(numbers) and self._disabled.issuperset(numbers)


_TEXT_STATE = {b"Tz": ("width", 0.01), b"Tc": ("spacing", 1.0), b"Ts": ("rise", 1.0)}
_COLOUR_OPERATORS: dict[bytes, tuple[str, Any]] = {
    b"g": ("fill", "/DeviceGray"),
    b"rg": ("fill", "/DeviceRGB"),
    b"k": ("fill", "/DeviceCMYK"),
    b"cs": ("fill", "chosen"),
    b"sc": ("fill", ""),
    b"scn": ("fill", ""),
    b"G": ("stroke", "/DeviceGray"),
    b"RG": ("stroke", "/DeviceRGB"),
    b"K": ("stroke", "/DeviceCMYK"),
    b"CS": ("stroke", "chosen"),
    b"SC": ("stroke", ""),
    b"SCN": ("stroke", ""),
}
"""Operators of colours, and the colour space that each sets: that of its operand, or none."""


def _initial_colour(space: Any) -> list[float]:
    """The colour after a colour space was chosen (ISO 32000-1, 8.6.8), if it can be white."""
    match _family(space):
        case "/Separation":
            return [1.0]
        case "/DeviceN":
            return [1.0] * len(space[1].get_object())
        case "/ICCBased":
            return [0.0] * int(space[1].get_object()["/N"])
        case _:
            return []


def _is_white(space: Any, numbers: list[float]) -> bool:
    """Whether the colour with these components in `space` is white, as far as it is understood.

    A tint of a colour that is not understood counts as white if it is zero or full.
    """
    family = _family(space)
    if not numbers:
        return False
    if family in ("/Separation", "/DeviceN"):
        colour = _tinted(space[3].get_object(), numbers)
        return _is_white(space[2].get_object(), colour) if colour else _is_extreme(numbers)
    if family == "/Indexed":
        return _is_white(space[1].get_object(), _indexed(space, int(numbers[0])))
    if family == "/Lab":
        return numbers[0] >= 100.0 * WHITE_THRESHOLD
    if family == "/DeviceCMYK" or len(numbers) == 4:
        return max(numbers) <= 1.0 - WHITE_THRESHOLD
    return len(numbers) in {1, 3} and min(numbers) >= WHITE_THRESHOLD


def _indexed(space: Any, index: int) -> list[float]:
    """The colour with this `index` in the table of an indexed colour space (ISO 32000-1, 8.6.6.3)."""
    base, table = space[1].get_object(), space[3].get_object()
    data: bytes = table.get_data() if hasattr(table, "get_data") else table.original_bytes
    counts = {"/DeviceGray": 1, "/CalGray": 1, "/DeviceCMYK": 4}
    count = int(base[1].get_object()["/N"]) if _family(base) == "/ICCBased" else counts.get(_family(base), 3)
    return [value / 255.0 for value in data[index * count : (index + 1) * count]]


def _is_extreme(numbers: list[float]) -> bool:
    return min(numbers) >= WHITE_THRESHOLD or max(numbers) <= 1.0 - WHITE_THRESHOLD


def _family(space: Any) -> str:
    parts = cast("list[Any]", space) if isinstance(space, list) else [space]
    return str(parts[0]) if parts else ""


def _tinted(function: Any, numbers: list[float]) -> list[float]:
    """The colour of one tint by an exponential function (ISO 32000-1, 7.10.3); empty for functions of other types."""
    if len(numbers) != 1 or function.get("/FunctionType") != 2:
        return []
    none, full = _resolve(function, "/C0") or [0.0], _resolve(function, "/C1") or [1.0]
    share = min(max(numbers[0], 0.0), 1.0) ** _number(function["/N"])
    return [(1.0 - share) * _number(first) + share * _number(last) for first, last in zip(none, full, strict=False)]


def _number(value: Any) -> float:
    """The number `value`, which may be a reference to one."""
    return float(value.get_object() if hasattr(value, "get_object") else value)


def disabled_layers(reader: Any) -> frozenset[int]:
    """Object numbers of the layers that are switched off when the document is opened."""
    properties = _resolve(reader.trailer["/Root"], "/OCProperties")
    start = _resolve(properties, "/D")
    off_by_default = start.get("/BaseState") == "/OFF"
    off: Any = _resolve(properties, "/OCGs") if off_by_default else _resolve(start, "/OFF")
    on: Any = _resolve(start, "/ON") if off_by_default else ()
    return frozenset(int(one.idnum) for one in off) - frozenset(int(one.idnum) for one in on)


def _resolve(holder: Any, key: str) -> Any:
    """The value of `key` in a dictionary; an empty dictionary without it."""
    return holder[key].get_object() if key in holder else _EmptyDictionary()


class _EmptyDictionary(dict[str, Any]):
    """A dictionary without entries, for a missing entry of a PDF object."""


def _multiply(m: Sequence[float], n: Sequence[float]) -> Matrix:
    """Product m n of two affine maps, rows first."""
    return (
        m[0] * n[0] + m[1] * n[2],
        m[0] * n[1] + m[1] * n[3],
        m[2] * n[0] + m[3] * n[2],
        m[2] * n[1] + m[3] * n[3],
        m[4] * n[0] + m[5] * n[2] + n[4],
        m[4] * n[1] + m[5] * n[3] + n[5],
    )


def _operand_text(shown: Any) -> str:
    parts = cast("list[Any]", shown if isinstance(shown, list) else [shown])
    texts = (part.decode("latin-1") if isinstance(part, bytes) else part for part in parts)
    return "".join(text for text in texts if isinstance(text, str))
