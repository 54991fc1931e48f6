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
MAX_FORM_DEPTH = 6
"""Largest nesting of forms whose resources are read."""
TEXT_OPERATORS = (b"Tj", b"TJ", b"'", b'"')


@dataclass(slots=True, kw_only=True)
class _GraphicsState:
    """The part of the graphics state that determines the visibility of text."""

    mode: int = 0
    size: float = 12.0
    width: float = 1.0
    spacing: float = 0.0
    rise: float = 0.0
    white_fill: bool = False
    white_stroke: bool = False
    clear_fill: bool = False
    clear_stroke: bool = False
    layer: bool = False
    content: list[bool] = field(default_factory=list)

    def hidden_reason(self) -> str:
        """The reason why text is invisible in this state; "" if it is visible."""
        paints = (
            (self.mode in FILLING_MODES, self.white_fill, self.clear_fill),
            (self.mode in STROKING_MODES, self.white_stroke, self.clear_stroke),
        )
        used = [(white, clear) for used, white, clear in paints if used]
        reasons = {
            "a layer that is off": self.layer or any(self.content),
            "invisible text": not used,
            "text without width": abs(self.width) < MIN_WIDTH_SHARE or self.spacing <= -MAX_OVERLAP * abs(self.size),
            "white text": all(white for white, _ in used),
            "transparent text": all(white or clear for white, clear in used),
        }
        return next((reason for reason, holds in reasons.items() if holds), "")


class VisibleTextFilter:
    """Visits the operators of one page; invisible text is not extracted but added to `hidden`, by kind."""

    def __init__(self, page: Any, disabled: frozenset[int], hidden: dict[str, list[str]]) -> None:
        """Create a filter for `page`; `disabled` are the object numbers of the layers that are switched off."""
        self._hidden, self._disabled = hidden, disabled
        self._state, self._stack = _GraphicsState(), list[_GraphicsState]()
        self._box = [float(value) for value in page.cropbox]
        self._layers, self._states, self._forms = dict[str, Any](), dict[str, _Opacity](), dict[str, Any]()
        _collect_resources(_resolve(page, "/Resources"), self._layers, self._states, self._forms, MAX_FORM_DEPTH)

    def visit_before(self, operator: bytes, operands: list[Any], cm: list[float], tm: list[float]) -> None:
        """Apply `operator` to the state; clear the operands of an operator that shows invisible text."""
        match operator:
            case b"q":
                self._stack.append(_copy_state(self._state))
            case b"Q" if self._stack:
                self._state = self._stack.pop()
            case b"Do" if operands:
                self._stack.append(_copy_state(self._state))
                form = self._forms.get(str(operands[0]), _EmptyDictionary())
                self._state.layer |= "/OC" in form and self._is_disabled(form.raw_get("/OC"))
            case b"BDC" | b"BMC":
                self._state.content.append(self._in_hidden_layer(operands))
            case b"EMC" if self._state.content:
                self._state.content.pop()
            case _ if operator in TEXT_OPERATORS and operands:
                self._filter_text(operands, cm, tm)
            case _:
                self._update_state(operator, operands)

    def visit_after(self, operator: bytes, operands: list[Any], cm: list[float], tm: list[float]) -> None:
        """Restore the state after a form."""
        if operator == b"Do" and operands and self._stack:
            self._state = self._stack.pop()

    def _update_state(self, operator: bytes, operands: list[Any]) -> None:
        """Apply an operator that sets the state; operands that are not numbers are ignored."""
        numbers = [float(value) for value in operands if isinstance(value, (int, float))]
        if operator == b"Tr" and numbers:
            self._state.mode = int(numbers[0])
        elif operator == b"Tf" and numbers:
            self._state.size = numbers[-1]
        elif operator in _TEXT_STATE and numbers:
            name, unit = _TEXT_STATE[operator]
            setattr(self._state, name, numbers[0] * unit)
        elif operator in _FILL_OPERATORS:
            self._state.white_fill = _is_white(_FILL_OPERATORS[operator], numbers)
        elif operator in _STROKE_OPERATORS:
            self._state.white_stroke = _is_white(_STROKE_OPERATORS[operator], numbers)
        elif operator == b"gs" and operands:
            opacity = self._states.get(str(operands[0]), _Opacity())
            fill, stroke = opacity.fill, opacity.stroke
            self._state.clear_fill = self._state.clear_fill if fill is None else fill < MIN_OPACITY
            self._state.clear_stroke = self._state.clear_stroke if stroke is None else stroke < MIN_OPACITY

    def _filter_text(self, operands: list[Any], cm: list[float], tm: list[float]) -> None:
        a, b, c, d, e, f = _multiply((1.0, 0.0, 0.0, 1.0, 0.0, self._state.rise), _multiply(tm, cm))
        scale = sqrt(abs(a * d - b * c))
        left, bottom, right, top = self._box
        on_page = left - 1.0 <= e <= right + 1.0 and bottom - 1.0 <= f <= top + 1.0
        reason = self._state.hidden_reason() or (
            "tiny text" if abs(self._state.size) * scale < MIN_TEXT_HEIGHT_PT else ""
        )
        reason = reason or ("" if on_page else "text off the page")
        if reason:
            self._hidden.setdefault(reason, []).append(_operand_text(operands[-1]))
            operands[-1] = type(operands[-1])()

    def _in_hidden_layer(self, operands: list[Any]) -> bool:
        if len(operands) < 2 or str(operands[0]) != "/OC":
            return False
        return self._is_disabled(self._layers.get(str(operands[1])))

    def _is_disabled(self, reference: Any) -> bool:
        """Whether a layer, or every layer of a membership dictionary, is switched off."""
        if reference is None:
            return False
        if getattr(reference, "idnum", None) in self._disabled:
            return True
        members: Any = _resolve(reference.get_object(), "/OCGs")
        numbers = [int(one.idnum) for one in members if hasattr(one, "idnum")]
        return bool(numbers) and self._disabled.issuperset(numbers)


@dataclass(frozen=True, slots=True)
class _Opacity:
    """The opacities that a graphics state sets; None if it sets none."""

    fill: float | None = None
    stroke: float | None = None


_TEXT_STATE = {b"Tz": ("width", 0.01), b"Tc": ("spacing", 1.0), b"Ts": ("rise", 1.0)}
_FILL_OPERATORS = {b"g": "gray", b"rg": "rgb", b"k": "cmyk", b"sc": "any", b"scn": "any", b"cs": "space"}
_STROKE_OPERATORS = {b"G": "gray", b"RG": "rgb", b"K": "cmyk", b"SC": "any", b"SCN": "any", b"CS": "space"}


def _is_white(kind: str, numbers: list[float]) -> bool:
    """Whether the operands of a colour operator are white; in a space of four components, zero everywhere is white."""
    if not numbers or kind == "space":
        return False
    if kind == "cmyk" or len(numbers) == 4:
        return max(numbers) <= 1.0 - WHITE_THRESHOLD
    return len(numbers) in {1, 3} and min(numbers) >= WHITE_THRESHOLD


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


def _collect_resources(
    resources: Any, layers: dict[str, Any], opacities: dict[str, _Opacity], forms: dict[str, Any], depth: int
) -> None:
    """Collect layers, opacities and forms by name from the page and its forms; for a name the lower opacity counts."""
    named = _resolve(resources, "/Properties")
    layers.update({str(name): named.raw_get(name) for name in named})
    states = _resolve(resources, "/ExtGState")
    for name in states:
        known, state = opacities.get(str(name), _Opacity()), states[name].get_object()
        fill, stroke = _lower(known.fill, state.get("/ca")), _lower(known.stroke, state.get("/CA"))
        if not isinstance(state.get("/SMask", ""), str):  # a mask other than /None: what it leaves is not known
            fill = stroke = 0.0
        opacities[str(name)] = _Opacity(fill, stroke)
    inner = _resolve(resources, "/XObject")
    for name in inner:
        form = inner[name].get_object()
        forms[str(name)] = form
        if depth:
            _collect_resources(_resolve(form, "/Resources"), layers, opacities, forms, depth - 1)


def _lower(known: float | None, declared: Any) -> float | None:
    """The lower of two opacities, of which one or both may not be declared."""
    if declared is None:
        return known
    value = float(declared.get_object() if hasattr(declared, "get_object") else declared)
    return value if known is None else min(known, value)


def _copy_state(state: _GraphicsState) -> _GraphicsState:
    duplicate = copy(state)
    duplicate.content = list(state.content)
    return duplicate


def _multiply(m: Sequence[float], n: Sequence[float]) -> tuple[float, ...]:
    """Product m n of two affine maps (a, b, c, d, e, f), rows first (ISO 32000-1, 8.3.4)."""
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
    return "".join(str(part) for part in parts if isinstance(part, (str, bytes)))
