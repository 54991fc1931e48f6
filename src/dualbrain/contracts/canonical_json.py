"""Canonical JSON (RFC 8785): exactly one byte string for each value, so that its hash identifies the value."""

from __future__ import annotations

import json
import math
from typing import cast

from dualbrain.errors import ConfigurationError

_MAX_EXACT_INTEGER = 2**53
"""Largest integer that double precision represents exactly together with its neighbours; RFC 8785 assumes doubles."""


def canonical_json(value: object) -> bytes:
    """The RFC 8785 form of `value` in UTF-8.

    No white space, keys sorted by UTF-16 code units, numbers as in ECMAScript.

    Raises:
        ConfigurationError: JSON cannot represent `value` exactly (NaN, infinities, integers beyond 2^53, other types).
    """
    return _encode(value).encode()


def _encode(value: object) -> str:
    """The canonical text of one JSON value."""
    if value is None or isinstance(value, (bool, str)):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, (int, float)):
        return _encode_number(value)
    if isinstance(value, (list, tuple)):
        return "[" + ",".join(_encode(item) for item in cast("list[object]", value)) + "]"
    if isinstance(value, dict):
        members = sorted(cast("dict[str, object]", value).items(), key=lambda member: member[0].encode("utf-16-be"))
        return "{" + ",".join(f"{_encode(key)}:{_encode(item)}" for key, item in members) + "}"
    raise ConfigurationError("value in canonical JSON", got=type(value).__name__, allowed="JSON types")


def _encode_number(value: float) -> str:
    """`value` as ECMAScript's Number::toString writes it: shortest digits that round-trip, plain from 1e-6 to 1e21."""
    if not math.isfinite(value) or (isinstance(value, int) and abs(value) > _MAX_EXACT_INTEGER):
        raise ConfigurationError("number in canonical JSON", got=value, allowed="finite numbers, integers up to 2^53")
    if value == 0:
        return "0"
    sign = "-" if value < 0 else ""
    digits, point = _shortest_digits(abs(float(value)))
    if len(digits) <= point <= 21:
        return sign + digits + "0" * (point - len(digits))
    if 0 < point <= 21:
        return f"{sign}{digits[:point]}.{digits[point:]}"
    if -6 < point <= 0:
        return sign + "0." + "0" * -point + digits
    mantissa = digits if len(digits) == 1 else f"{digits[0]}.{digits[1:]}"
    return f"{sign}{mantissa}e{point - 1:+d}"


def _shortest_digits(value: float) -> tuple[str, int]:
    """Shortest decimal digits d and decimal point n with value = 0.d × 10^n (Python's repr finds the digits)."""
    mantissa, _, exponent = repr(value).partition("e")
    whole, _, fraction = mantissa.partition(".")
    digits = (whole + fraction).lstrip("0")
    point = len(whole) + int(exponent or 0) - (len(whole + fraction) - len(digits))
    return digits.rstrip("0"), point
