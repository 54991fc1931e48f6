"""Filter for the visible text of a PDF page: tracks the graphics state and removes text that is not visible."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field
from math import sqrt
from typing import Any, cast

MIN_TEXT_HEIGHT_PT = 2.0
"""Text with a smaller height [pt] counts as hidden."""
MIN_OPACITY = 0.05
"""Text with a smaller opacity counts as hidden."""
WHITE_THRESHOLD = 0.97
"""Text whose colour components are all at least this value counts as white."""
INVISIBLE_RENDERING_MODES = (3, 7)
"""Text rendering modes that fill and stroke nothing (ISO 32000-1, 9.3.6)."""
MAX_FORM_DEPTH = 6
"""Largest nesting of forms whose resources are read."""
TEXT_OPERATORS = (b"Tj", b"TJ", b"'", b'"')


@dataclass(slots=True, kw_only=True)
class _GraphicsState:
    """The part of the graphics state that determines the visibility of text."""

    mode: int = 0
    size: float = 12.0
    white: bool = False
    transparent: bool = False
    layer: bool = False
    content: list[bool] = field(default_factory=list)

    def hidden_reason(self) -> str:
        """The reason why text is invisible in this state; "" if it is visible."""
        reasons = {
            "invisible text": self.mode in INVISIBLE_RENDERING_MODES,
            "white text": self.white,
            "transparent text": self.transparent,
            "a layer that is off": self.layer or any(self.content),
        }
        return next((reason for reason, holds in reasons.items() if holds), "")


class VisibleTextFilter:
    """Visits the operators of one page; invisible text is not extracted but added to `hidden`, by kind."""

    def __init__(self, page: Any, disabled: frozenset[int], hidden: dict[str, list[str]]) -> None:
        """Create a filter for `page`; `disabled` are the object numbers of the layers that are switched off."""
        self._hidden, self._disabled = hidden, disabled
        self._state, self._stack = _GraphicsState(), list[_GraphicsState]()
        self._box = [float(value) for value in page.cropbox]
        self._layers, self._transparent, self._forms = dict[str, Any](), dict[str, bool](), dict[str, Any]()
        _collect_resources(_resolve(page, "/Resources"), self._layers, self._transparent, self._forms, MAX_FORM_DEPTH)

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
        elif operator in {b"g", b"rg", b"sc", b"scn"} and numbers:
            self._state.white = len(numbers) in {1, 3} and min(numbers) >= WHITE_THRESHOLD
        elif operator == b"k" and numbers:
            self._state.white = max(numbers) <= 1.0 - WHITE_THRESHOLD
        elif operator == b"cs":
            self._state.white = False
        elif operator == b"gs" and operands:
            self._state.transparent = self._transparent.get(str(operands[0]), self._state.transparent)

    def _filter_text(self, operands: list[Any], cm: list[float], tm: list[float]) -> None:
        a, b, c, d, e, f = _multiply(tm, cm)
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
    resources: Any, layers: dict[str, Any], transparent: dict[str, bool], forms: dict[str, Any], depth: int
) -> None:
    """Collect layers, opacities and forms by name from the page and its forms; for a name the lower opacity counts."""
    named = _resolve(resources, "/Properties")
    layers.update({str(name): named.raw_get(name) for name in named})
    states = _resolve(resources, "/ExtGState")
    for name in states:
        alpha: Any = states[name].get_object().get("/ca")
        if alpha is not None:
            transparent[str(name)] = transparent.get(str(name), False) or float(alpha) < MIN_OPACITY
    inner = _resolve(resources, "/XObject")
    for name in inner:
        form = inner[name].get_object()
        forms[str(name)] = form
        if depth:
            _collect_resources(_resolve(form, "/Resources"), layers, transparent, forms, depth - 1)


def _copy_state(state: _GraphicsState) -> _GraphicsState:
    duplicate = copy(state)
    duplicate.content = list(state.content)
    return duplicate


def _multiply(m: list[float], n: list[float]) -> tuple[float, ...]:
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
