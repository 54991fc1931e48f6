"""Whether the objects of a table scene are where objects can be: problems in words, each with a remedy."""

from __future__ import annotations

import re
from itertools import combinations
from math import atan2, cos, hypot, pi, sin

from dualbrain.core.geometry.polygons import Point, intersect_convex
from dualbrain.core.geometry.shapes import Bowl, Box, Capsule, Cylinder, HalfSpace, Shape, Sphere
from dualbrain.simulation.scenes.colours import COLOUR_RGBA
from dualbrain.simulation.scenes.scene_spec import TABLE_X, TABLE_Y, ObjectSpec, SceneSpec

NAME_PATTERN = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,47}")
BASE_RADIUS = 0.12
"""Radius of the base of an arm on the table [m]."""
CIRCLE_CORNERS = 24
HEIGHT_TOLERANCE = 1e-3
"""Depth [m] to which objects may reach into each other vertically: objects that are stacked touch."""
UPRIGHT_TOLERANCE = 0.02
"""Largest x and y component of the quaternion of an upright object."""


def arrangement_problems(spec: SceneSpec) -> list[str]:
    """One sentence per problem: names, colours, objects beside the table, in the base of the arm, or in each other.

    Objects that are tilted are not compared with others. A room is not checked.
    """
    if spec.region:
        return []
    problems = [problem for obj in spec.objects for problem in _object_problems(obj)]
    upright = [obj for obj in spec.objects if max(map(abs, obj.quaternion[1:3])) < UPRIGHT_TOLERANCE]
    return problems + [problem for one, other in combinations(upright, 2) if (problem := _overlap(one, other))]


def footprint(shape: Shape, position: Point, yaw: float) -> tuple[Point, ...]:
    """The corners of an upright shape seen from above, counter-clockwise; a circle becomes a polygon around it."""
    x, y = position
    match shape:
        case Box(half_extents=(a, b, _)):
            corners = ((a, b), (-a, b), (-a, -b), (a, -b))
        case Cylinder(radius=radius) | Bowl(radius=radius) | Sphere(radius=radius) | Capsule(radius=radius):
            outer = radius / cos(pi / CIRCLE_CORNERS)
            angles = [2.0 * pi * k / CIRCLE_CORNERS for k in range(CIRCLE_CORNERS)]
            corners = tuple((outer * cos(one), outer * sin(one)) for one in angles)
        case HalfSpace():
            corners = ()
    c, s = cos(yaw), sin(yaw)
    return tuple((x + c * u - s * v, y + s * u + c * v) for u, v in corners)


def yaw_of(obj: ObjectSpec) -> float:
    """The rotation of an upright object about the vertical [rad]."""
    return 2.0 * atan2(obj.quaternion[3], obj.quaternion[0])


def _object_problems(obj: ObjectSpec) -> list[str]:
    x, y, _ = obj.position
    problems: list[str] = []
    if not NAME_PATTERN.fullmatch(obj.name):
        problems.append(f"The name {obj.name[:60]!r} is not an identifier: use letters, digits, _ and -.")
    if obj.colour not in COLOUR_RGBA:
        problems.append(f"{obj.name}: the colour {obj.colour[:30]!r} is unknown: use one of {', '.join(COLOUR_RGBA)}.")
    if not (TABLE_X[0] <= x <= TABLE_X[1] and TABLE_Y[0] <= y <= TABLE_Y[1]):
        problems.append(
            f"{obj.name} is beside the table, at x {100 * x:.0f} cm, y {100 * y:.0f} cm: move it to x from "
            f"{100 * TABLE_X[0]:.0f} to {100 * TABLE_X[1]:.0f} cm and y from {100 * TABLE_Y[0]:.0f} to "
            f"{100 * TABLE_Y[1]:.0f} cm."
        )
    elif hypot(x, y) < BASE_RADIUS and not obj.fixed:
        away = 100.0 * BASE_RADIUS
        problems.append(f"{obj.name} is in the base of the robot: move it at least {away:.0f} cm away from x 0, y 0.")
    return problems


def _overlap(one: ObjectSpec, other: ObjectSpec) -> str:
    """The problem of two objects that are in each other; "" if they are not, or if one is in the other, a bowl."""
    (low, high), (bottom, top) = _heights(one), _heights(other)
    if min(high, top) - max(low, bottom) < HEIGHT_TOLERANCE or _is_inside(one, other) or _is_inside(other, one):
        return ""
    shapes = [footprint(obj.shape, obj.position[:2], yaw_of(obj)) for obj in (one, other)]
    shared = intersect_convex(*shapes) if all(shapes) else ()
    if not shared:
        return ""
    sizes = [max(corner[axis] for corner in shared) - min(corner[axis] for corner in shared) for axis in (0, 1)]
    return f"{one.name} and {other.name} overlap: move them apart by at least {100.0 * min(sizes):.1f} cm."


def _is_inside(obj: ObjectSpec, container: ObjectSpec) -> bool:
    if not isinstance(container.shape, Bowl):
        return False
    away = hypot(obj.position[0] - container.position[0], obj.position[1] - container.position[1])
    return away < container.shape.radius


def _heights(obj: ObjectSpec) -> tuple[float, float]:
    """Lowest and highest point of an upright object [m]."""
    z = obj.position[2]
    match obj.shape:
        case Box(half_extents=(_, _, half)) | Cylinder(half_height=half) | Sphere(radius=half):
            return z - half, z + half
        case Capsule(radius=radius, half_length=half):
            return z - half - radius, z + half + radius
        case Bowl(height=height):
            return z, z + height
        case HalfSpace():
            return -float("inf"), z
