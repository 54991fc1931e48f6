"""Values that no interface may take for a measurement, by kind, and the values of the same form that it must take."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

KINDS = ("nan", "infinite", "denormal", "negative", "huge", "empty", "wrong type", "wrong shape", "deep", "long")
"""Kinds of bad values; "valid" is the control."""
VALID = "valid"
WRONG_TYPES: tuple[Any, ...] = ("0.1", True, None, 0.1j, b"1", object(), {}, np.array([None, 1.0], object))

NUMBER, LENGTH, VECTOR, SIZES, QUATERNION = "number", "length", "vector", "sizes", "quaternion"
WISH = "wish"
"""A nominal control or the present time: it may be arbitrarily large, because a bound applies to what becomes of it."""
HARMLESS = {
    NUMBER: ("denormal", "negative"),
    LENGTH: (),
    VECTOR: ("denormal", "negative"),
    WISH: ("denormal", "negative", "huge"),
    SIZES: (),
    QUATERNION: ("negative",),
}
"""Kinds that are valid values of a form: a coordinate may be negative, and a denormal coordinate is 0 m."""


def make_value(kind: str, form: str, valid: Any, rng: np.random.Generator) -> Any:
    """A value of `kind` in place of the `valid` one, a number or a tuple of numbers."""
    if kind == VALID:
        return valid
    if kind in ("empty", "wrong type", "wrong shape", "deep", "long"):
        value = _STRUCTURES[kind](valid, rng)
        return "0.1" if form == WISH and value is True else value  # the time of a step may be a truth value
    numbers = [float(value) for value in np.atleast_1d(valid)]
    at = int(rng.integers(len(numbers)))
    if kind == "denormal" and form == QUATERNION:
        numbers = [value * 1e-170 for value in numbers]
    elif kind == "negative" and form == QUATERNION:
        numbers = [-value for value in numbers]
    else:
        numbers[at] = _number(kind, numbers[at], rng)
    return numbers[0] if np.ndim(valid) == 0 else tuple(numbers)


def _number(kind: str, valid: float, rng: np.random.Generator) -> float:
    match kind:
        case "nan":
            return float("nan")
        case "infinite":
            return float(rng.choice([-np.inf, np.inf]))
        case "denormal":
            return float(rng.choice([5e-324, 1e-310, 1e-40]))
        case "negative":
            return -abs(valid) or -float(10.0 ** rng.uniform(-12, 1))
        case _:
            return float(10.0 ** rng.uniform(13, 300))


def _deep(valid: Any, rng: np.random.Generator) -> Any:
    value = valid
    for _ in range(int(rng.choice([3, 100, 2000]))):
        value = [value]
    return value


def _wrong_type(valid: Any, rng: np.random.Generator) -> Any:
    value = WRONG_TYPES[int(rng.integers(len(WRONG_TYPES)))]
    if np.ndim(valid) == 0 or rng.random() < 0.3:
        return value
    numbers: list[Any] = [float(one) for one in valid]
    numbers[int(rng.integers(len(numbers)))] = "0.1" if isinstance(value, (bool, np.ndarray)) else value
    return tuple(numbers)


def _wrong_shape(valid: Any, rng: np.random.Generator) -> Any:
    if np.ndim(valid) == 0:
        return [valid] * int(rng.integers(2, 5))
    numbers = tuple(float(one) for one in valid)
    return (numbers[:-1], (*numbers, 0.0), (numbers, numbers), 0.5, np.array([numbers]))[int(rng.integers(5))]


_STRUCTURES: dict[str, Callable[[Any, np.random.Generator], Any]] = {
    "empty": lambda valid, rng: ((), [], "", np.empty(0))[int(rng.integers(4))],
    "wrong type": _wrong_type,
    "wrong shape": _wrong_shape,
    "deep": _deep,
    "long": lambda valid, rng: [0.5] * int(rng.choice([1000, 100_000])),
}
