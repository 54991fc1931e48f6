"""Fast decision whether a geometric value is usual: `validation` would return an equal one, in a tenth of the time.

Anything unusual (other types, a number near a limit, an object without a fast check) is not plain and is left to
`validation`, which accepts it or states why not.
"""

from __future__ import annotations

from typing import cast

from dualbrain.core.geometry import validation
from dualbrain.core.geometry.shapes import Bowl, Box, Capsule, Cylinder, HalfSpace, Pose, Sphere

_UNIT_TOLERANCE, _LEAST = 1e-9, validation.SMALLEST_LENGTH
_FAR, _FAST = validation.MAX_COORDINATE, validation.MAX_SPEED
_SIZES = {
    Sphere: ("radius",),
    Capsule: ("radius", "half_length"),
    Cylinder: ("radius", "half_height"),
    Bowl: ("radius", "height", "wall"),
    HalfSpace: (),
}


def is_plain_length(value: object) -> bool:
    """Whether `value` is a float that `check_length` accepts."""
    return type(value) is float and (_LEAST <= value <= _FAR or value == 0.0)


def is_plain_size(shape: object) -> bool:
    """Whether the sizes of a shape are floats within their bounds."""
    if type(shape) is Box:
        extents = cast("tuple[object, ...]", shape.half_extents)
        return type(extents) is tuple and len(extents) == 3 and all(map(is_plain_length, extents))
    names = _SIZES.get(cast("type[Sphere]", type(shape)))
    return names is not None and all(is_plain_length(getattr(shape, name)) for name in names)


def is_plain_pose(pose: object) -> bool:
    """Whether a pose has a position within bounds and a quaternion of length 1, as tuples of floats."""
    if type(pose) is not Pose:
        return False
    place, turn = pose.position, pose.quaternion
    if not (type(place) is type(turn) is tuple and (len(place), len(turn)) == (3, 4)):
        return False
    (x, y, z), (a, b, c, d) = place, turn
    return (
        type(x) is type(y) is type(z) is type(a) is type(b) is type(c) is type(d) is float
        and -_FAR <= x <= _FAR
        and -_FAR <= y <= _FAR
        and -_FAR <= z <= _FAR
        and -_UNIT_TOLERANCE < a * a + b * b + c * c + d * d - 1.0 < _UNIT_TOLERANCE
    )


def is_plain_motion(velocity: object, error: object) -> bool:
    """Whether a velocity [m/s] is a tuple of three floats, `error` is a float, and both are within their bounds."""
    if type(velocity) is not tuple or len(cast("tuple[object, ...]", velocity)) != 3:
        return False
    u, v, w = cast("tuple[object, object, object]", velocity)
    if not (type(u) is float and type(v) is float and type(w) is float and type(error) is float):
        return False
    slow = -_FAST <= u <= _FAST and -_FAST <= v <= _FAST and -_FAST <= w <= _FAST
    return slow and (error == 0.0 or _LEAST <= error <= _FAST)
