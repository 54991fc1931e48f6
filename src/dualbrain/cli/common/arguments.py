"""Parse command-line values."""

from __future__ import annotations

from dualbrain.errors import UsageError

MIN_FRACTION = 0.01


def parse_fraction(text: str) -> float:
    """The fraction in [0.01, 1] that `text` states as "10%" or "0.1"; raises `UsageError`."""
    try:
        value = float(text.removesuffix("%")) / (100.0 if text.endswith("%") else 1.0)
    except ValueError:
        value = float("nan")
    if not MIN_FRACTION <= value <= 1.0:
        raise UsageError("speed", got=text, allowed="1% to 100%, as 10% or 0.1")
    return value
