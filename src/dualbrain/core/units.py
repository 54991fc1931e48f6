"""Unit strings of contract parameters: coherent SI units in one spelling, checked by pint when a registry is built."""

from __future__ import annotations

import re
from functools import cache
from typing import TYPE_CHECKING

from dualbrain.errors import ConfigurationError

if TYPE_CHECKING:
    import pint

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
    import pint  # noqa: PLC0415 (the import takes half a second and is needed only when a registry is built)

    if not _UNIT_PATTERN.fullmatch(unit):
        raise ConfigurationError("unit", got=unit, allowed=_ALLOWED)
    registry = _pint_registry()
    try:
        for symbol in _SYMBOL_PATTERN.findall(unit):
            _require_symbol(symbol, registry)
        factor = registry.Quantity(1.0, registry.parse_units(unit)).to_base_units().magnitude
    except pint.errors.UndefinedUnitError as unknown:
        raise ConfigurationError("unit", got=unit, allowed=_ALLOWED) from unknown
    if factor != 1.0:
        raise ConfigurationError("unit", got=unit, allowed=_ALLOWED, fix=f"One {unit} is {factor:.6g} in base units.")
    return unit


def _require_symbol(symbol: str, registry: pint.UnitRegistry) -> None:
    """Raise `ConfigurationError` unless `symbol` is the short symbol of its unit."""
    short = format(registry.parse_units(symbol), "~C")
    if short != symbol:
        raise ConfigurationError("unit symbol", got=symbol, allowed=_ALLOWED, fix=f"Write {short or '1'!r}.")


@cache
def _pint_registry() -> pint.UnitRegistry:
    """The pint registry of this process."""
    import pint  # noqa: PLC0415

    return pint.UnitRegistry()
