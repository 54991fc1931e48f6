"""Validation of numbers, poses, shapes and arrays that come from outside: one place decides on their use.

Every function returns the value in its plain form (float, tuple, array of float64) or raises `GeometryError` with the
name of the field. A number is an integer or a real number of Python or numpy; text, truth values, None, complex numbers
and arrays of objects are refused, and so are values that are not finite.
"""

from __future__ import annotations

from collections.abc import Iterable, Sized
from itertools import islice
from math import inf, isfinite, sqrt
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.shapes import (
    Bowl,
    Box,
    Capsule,
    Cylinder,
    HalfSpace,
    Pose,
    Quaternion,
    Shape,
    Sphere,
    Vector,
)
from dualbrain.errors import GeometryError

T = TypeVar("T")
Array = NDArray[np.float64]

MAX_COORDINATE = 1000.0
"""Largest coordinate, size and margin [m]. The kernel computes in single precision, whose numbers are 0.06 mm apart at
this distance; beyond it the rounding exceeds the margins of the filter, and contact could be certified as clearance."""
MAX_SPEED = 1000.0
"""Largest velocity component and velocity error [m/s]."""
SMALLEST_LENGTH = float(np.finfo(np.float32).tiny)
"""Smallest size, margin, error or gain above 0 in SI units; a smaller number is not a measurement or a setting."""
QUATERNION_TOLERANCE = 0.1
"""Deviation of the length of a quaternion from 1 up to which it is normalised."""
MIN_DIRECTION_LENGTH = 1e-6
"""Length below which a vector has no direction."""
MAX_NAME_LENGTH = 1000
"""Most characters of a name."""
MAX_STAMP = 1e12
"""Largest time stamp [s], 30 000 years from the start of any clock."""

RELATIVE_FIX = "Give coordinates in metres relative to a frame near the robot, not map coordinates or millimetres."


# --- numbers ------------------------------------------------------------------------------------------------------


def is_real(value: object) -> bool:
    """Whether `value` is a real number; it need not be finite."""
    return _real(value) is not None


def check_real(name: str, value: object) -> float:
    """`value` as a float, which need not be finite."""
    number = _real(value)
    if number is None:
        raise GeometryError(name, got=value, allowed="a number")
    return number


def check_number(name: str, value: object, least: float = -inf, most: float = inf, *, fix: str = "") -> float:
    """`value` as a finite float from `least` to `most`."""
    number = _real(value)
    if number is None or not (least <= number <= most and isfinite(number)):
        raise GeometryError(name, got=value, allowed=_range(least, most), fix=_with_problem(fix, number))
    return number


def check_positive(name: str, value: object, most: float = inf, *, fix: str = "") -> float:
    """`value` as a finite float above 0, at most `most`."""
    number = _real(value)
    if number is None or not (SMALLEST_LENGTH <= number <= most and isfinite(number)):
        raise GeometryError(
            name, got=value, allowed=f"a number above 0{_at_most(most)}", fix=_with_problem(fix, number)
        )
    return number


def check_length(name: str, value: object, most: float = MAX_COORDINATE) -> float:
    """`value` as a size, margin, error, speed or duration: 0, or from `SMALLEST_LENGTH` to `most`."""
    number = _real(value)
    if number is None or not (number == 0.0 or SMALLEST_LENGTH <= number <= most):
        problem = _with_problem("Sizes, margins and errors are in SI units.", number, least=0.0)
        raise GeometryError(name, got=value, allowed=f"0 or more{_at_most(most)}", fix=problem)
    return number


def check_stamp(name: str, value: object) -> float:
    """`value` as a time stamp [s]."""
    if type(value) is float and -MAX_STAMP <= value <= MAX_STAMP:  # the usual case
        return value
    return check_number(
        name, value, -MAX_STAMP, MAX_STAMP, fix="Stamps are seconds on the clock of the filter's `now`."
    )


def check_flag(name: str, value: object) -> bool:
    """`value` as a truth value; numbers are refused."""
    if value is True or value is False:
        return value
    if not isinstance(value, np.bool_):
        raise GeometryError(name, got=value, allowed="True or False")
    return value.item() is True


def check_name(name: str, value: object) -> str:
    """`value` as a text of at most `MAX_NAME_LENGTH` characters."""
    if not isinstance(value, str) or len(value) > MAX_NAME_LENGTH:
        raise GeometryError(name, got=value, allowed=f"a text of at most {MAX_NAME_LENGTH} characters")
    return value


def check_instance(name: str, value: object, kind: type[T]) -> T:
    """`value`, an instance of `kind`."""
    if not isinstance(value, kind):
        raise GeometryError(name, got=value, allowed=f"an instance of {kind.__name__}")
    return value


def check_sequence(name: str, values: object, most: int, *, of: str) -> tuple[Any, ...]:
    """The items of `values`, at most `most`; an endless iterator ends at the limit."""
    if not isinstance(values, Iterable) or isinstance(values, (str, bytes, dict)):
        raise GeometryError(name, got=cast("object", values), allowed=f"a sequence of {of}")
    items = cast("Iterable[Any]", values)
    if isinstance(items, Sized) and len(items) > most:
        raise GeometryError(name, got=len(items), allowed=f"at most {most} {of}")
    found = tuple(islice(items, most + 1))
    if len(found) > most:
        raise GeometryError(name, got=f"more than {most}", allowed=f"at most {most} {of}")
    return found


# --- vectors, poses, shapes ---------------------------------------------------------------------------------------


def check_vector(name: str, values: object, most: float = MAX_COORDINATE, *, fix: str = RELATIVE_FIX) -> Vector:
    """`values` as three numbers within ±`most`."""
    x, y, z = _numbers(name, values, 3, -most, most, fix)
    return (x, y, z)


def check_direction(name: str, values: object) -> Vector:
    """`values` as a unit vector; the length of the given vector is free, but above 1e-6."""
    x, y, z = check_vector(name, values, fix="")
    size = sqrt(x * x + y * y + z * z)
    if not size > MIN_DIRECTION_LENGTH:
        raise GeometryError(name, got=values, allowed="a vector that is not zero")
    return (x / size, y / size, z / size)


def check_velocity(name: str, values: object) -> Vector:
    """`values` as a velocity (3,) [m/s]."""
    return check_vector(name, values, MAX_SPEED, fix="Velocities are in m/s.")


def check_quaternion(name: str, values: object) -> Quaternion:
    """`values` as a quaternion (w, x, y, z) of length 1; one that is nearly of length 1 is normalised."""
    w, x, y, z = _numbers(name, values, 4, -2.0, 2.0, "Quaternions are (w, x, y, z) of length 1.")
    size = sqrt(w * w + x * x + y * y + z * z)
    if not abs(size - 1.0) <= QUATERNION_TOLERANCE:
        raise GeometryError(
            name,
            got=values,
            allowed=f"length 1 within {QUATERNION_TOLERANCE:g}, not {size:.3g}",
            fix="Divide the quaternion (w, x, y, z) by its length.",
        )
    return (w, x, y, z) if abs(size - 1.0) < 1e-9 else (w / size, x / size, y / size, z / size)


def check_pose(name: str, pose: object) -> Pose:
    """`pose` with a position within bounds and a quaternion of length 1."""
    given = check_instance(name, pose, Pose)
    return Pose(
        check_vector(f"position of {name}", given.position), check_quaternion(f"quaternion of {name}", given.quaternion)
    )


def check_shape(name: str, shape: object, kinds: tuple[type[Any], ...] = ()) -> Shape:
    """`shape` with sizes of 0 or more, at most `MAX_COORDINATE`; `kinds` are the types allowed, by default all."""
    if kinds and not isinstance(shape, kinds):
        raise GeometryError(name, got=shape, allowed=f"one of {', '.join(kind.__name__ for kind in kinds)}")
    match shape:
        case Sphere(radius=radius):
            return Sphere(check_length(f"radius of {name}", radius))
        case Capsule(radius=radius, half_length=half):
            return Capsule(check_length(f"radius of {name}", radius), check_length(f"half_length of {name}", half))
        case Cylinder(radius=radius, half_height=half):
            return Cylinder(check_length(f"radius of {name}", radius), check_length(f"half_height of {name}", half))
        case Box(half_extents=extents):
            field = f"half_extents of {name}"
            x, y, z = (check_length(field, size) for size in _numbers(field, extents, 3, 0.0, MAX_COORDINATE, ""))
            return Box((x, y, z))
        case HalfSpace():
            return shape
        case Bowl(radius=radius, height=height, wall=wall):
            return Bowl(
                check_length(f"radius of {name}", radius),
                check_length(f"height of {name}", height),
                check_length(f"wall of {name}", wall),
            )
        case _:
            raise GeometryError(name, got=shape, allowed="a Sphere, Capsule, Cylinder, Box, HalfSpace or Bowl")


# --- arrays -------------------------------------------------------------------------------------------------------


def check_array(name: str, values: object, shape: tuple[int, ...], most: float = inf, *, fix: str = "") -> Array:
    """`values` as a finite array of float64 of this shape, within ±`most`; −1 is any length of an axis."""
    array = as_real_array(name, values, shape)
    if not bool(np.all(np.abs(array) <= most) and np.isfinite(array).all()):
        problem = "" if np.isfinite(array).all() else "A number is not finite."
        raise GeometryError(
            name, got=values, allowed=f"finite numbers{_at_most(most, both=True)}", fix=f"{problem} {fix}".strip()
        )
    return array


def as_real_array(name: str, values: object, shape: tuple[int, ...] | None = None) -> Array:
    """`values` as a contiguous array of float64 of this shape, by default any, without a copy if it is one already.

    Its numbers may be anything, also not finite: a control step answers such a state with a stop.
    """
    if (
        type(values) is np.ndarray
        and values.dtype == np.float64
        and values.shape == shape
        and values.flags.c_contiguous
    ):
        return values  # the usual case
    allowed = f"an array{'' if shape is None else f' {shape}'.replace('-1', 'k')} of numbers"
    try:
        array = np.asarray(cast("Any", values))
    except (TypeError, ValueError, OverflowError, RuntimeError):  # also RecursionError, and a tensor with a gradient
        raise GeometryError(name, got=values, allowed=allowed) from None
    if array.dtype.kind not in "iuf":
        raise GeometryError(name, got=values, allowed=allowed)
    if shape is not None and (
        array.ndim != len(shape) or any(want not in (-1, have) for have, want in zip(array.shape, shape, strict=True))
    ):
        raise GeometryError(name, got=array.shape, allowed=allowed)
    return np.asarray(array, float, order="C")


# --- private ------------------------------------------------------------------------------------------------------


def _real(value: object) -> float | None:
    """`value` as a float, or None if it is not a real number."""
    if type(value) is float:
        return value
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, float, np.integer, np.floating)):
        return None
    try:
        return float(cast("Any", value))
    except OverflowError:
        return None


def _numbers(name: str, values: object, count: int, least: float, most: float, fix: str) -> tuple[float, ...]:
    """`values`, a tuple, list or array of `count` numbers from `least` to `most`."""
    given: Any = values
    if isinstance(given, np.ndarray) and given.ndim == 1:
        given = given.tolist()
    if not isinstance(given, (tuple, list)) or len(cast("tuple[Any, ...]", given)) != count:
        raise GeometryError(name, got=values, allowed=f"{count} numbers", fix=fix)
    numbers = tuple(_real(value) for value in cast("tuple[Any, ...]", given))
    if not all(number is not None and least <= number <= most for number in numbers):
        problem = _with_problem(fix, *numbers, least=least)
        raise GeometryError(name, got=values, allowed=f"{count} numbers, each {_range(least, most)}", fix=problem)
    return cast("tuple[float, ...]", numbers)


def _with_problem(fix: str, *numbers: float | None, least: float = -inf) -> str:
    """The remedy `fix`, after the fault of the numbers."""
    problem = ""
    if any(number is not None and not isfinite(number) for number in numbers):
        problem = "A number is not finite."
    elif least == 0.0 and any(number is not None and number < 0.0 for number in numbers):
        problem = "A length is below zero."
    return f"{problem} {fix}".strip()


def _range(least: float, most: float) -> str:
    if least == -inf and most == inf:
        return "a finite number"
    if most == inf:
        return f"a finite number of at least {least:g}"
    return f"a number from {least:g} to {most:g}"


def _at_most(most: float, *, both: bool = False) -> str:
    return "" if most == inf else f" within ±{most:g}" if both else f", at most {most:g}"
