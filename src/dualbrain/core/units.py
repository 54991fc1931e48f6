"""Unit strings of contract parameters: coherent SI units in one spelling."""

from __future__ import annotations

import re
from functools import cache

from dualbrain.errors import ConfigurationError

_BASE_SYMBOLS = ("m", "kg", "s", "A", "K", "mol", "cd")
_DERIVED_SYMBOLS = (
    *("rad", "sr", "Hz", "N", "Pa", "J", "W", "C", "V", "F", "S"),
    *("Wb", "T", "H", "lm", "lx", "Bq", "Gy", "Sv", "kat"),
)
SI_SYMBOLS = frozenset((*_BASE_SYMBOLS, *_DERIVED_SYMBOLS))
"""The base units of the SI, and its named derived units that have an ASCII symbol; all are coherent."""
_UNIT_PATTERN = re.compile(r"(?:1|[A-Za-z]+(?:\*\*[2-4])?)(?:[*/][A-Za-z]+(?:\*\*[2-4])?)*")
_SYMBOL_PATTERN = re.compile(r"[A-Za-z]+")
_ALLOWED = "an SI unit without prefix, in symbols: 1, m, rad, s, kg, N, m/s, rad/s, m/s**2, N*m"


@cache
def require_si(unit: str) -> str:
    """Return `unit` if it is a coherent SI unit in its short spelling.

    A coherent unit is a product of powers of the SI base units with the factor 1 (N = kg m/s²), so no number needs a
    conversion factor: "mm", "deg" and "km/h" are refused. Each unit has one spelling ("m", never "metre"), so that
    schema, prompt, documents and registry hash contain the same string.

    Raises:
        ConfigurationError: `unit` is not such a unit.
    """
    if not _UNIT_PATTERN.fullmatch(unit):
        raise ConfigurationError("unit", got=unit, allowed=_ALLOWED)
    for symbol in _SYMBOL_PATTERN.findall(unit):
        if symbol not in SI_SYMBOLS:
            fix = f"{symbol!r} is not one of {', '.join(sorted(SI_SYMBOLS))}: convert the numbers to one of them."
            raise ConfigurationError("unit", got=unit, allowed=_ALLOWED, fix=fix)
    return unit
