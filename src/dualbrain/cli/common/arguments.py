"""Kinds of command-line values, and their parsing."""

from __future__ import annotations

from typing import Annotated

from cyclopts import Parameter
from cyclopts.validators import Number

from dualbrain.errors import UsageError

MAX_PORT = 65535
Port = Annotated[int, Parameter(validator=Number(gte=1, lte=MAX_PORT))]
"""A TCP port."""
PortOrAny = Annotated[int, Parameter(validator=Number(gte=0, lte=MAX_PORT))]
"""A TCP port, or 0 for any free one."""
Seed = Annotated[int, Parameter(validator=Number(gte=0, lt=2**63))]
"""A seed of random numbers, which a record can hold."""
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
