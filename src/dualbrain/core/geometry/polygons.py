"""Intersection of two convex polygons."""

from __future__ import annotations

from math import hypot

Point = tuple[float, float]

MIN_CORNER_DISTANCE = 1e-3
"""A corner nearer than this [m] to the next corner, or to the line between its neighbours, is dropped."""


def intersect_convex(one: tuple[Point, ...], other: tuple[Point, ...]) -> tuple[Point, ...]:
    """The corners of `one` ∩ `other`, both convex and counter-clockwise; () if the intersection is empty.

    `one` is clipped along every edge of `other` (Sutherland and Hodgman, 1974). Degenerate corners are dropped, which
    can only make the polygon smaller.
    """
    remaining = one
    for a, b in zip(other, other[1:] + other[:1], strict=True):
        remaining = _clip(remaining, a, b)
    return _drop_degenerate_corners(remaining)


def _signed_distance(point: Point, a: Point, b: Point) -> float:
    """Distance [m] of `point` from the line through `a` and `b`, positive to its left."""
    along = (b[0] - a[0], b[1] - a[1])
    return (along[0] * (point[1] - a[1]) - along[1] * (point[0] - a[0])) / hypot(*along)


def _clip(polygon: tuple[Point, ...], a: Point, b: Point) -> tuple[Point, ...]:
    """The part of `polygon` to the left of the line from `a` to `b`."""
    kept: list[Point] = []
    for p, q in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        here, there = _signed_distance(p, a, b), _signed_distance(q, a, b)
        if here >= 0.0:
            kept.append(p)
        if (here > 0.0 > there) or (here < 0.0 < there):
            share = here / (here - there)
            kept.append((p[0] + share * (q[0] - p[0]), p[1] + share * (q[1] - p[1])))
    return tuple(kept)


def _drop_degenerate_corners(polygon: tuple[Point, ...]) -> tuple[Point, ...]:
    """`polygon` without degenerate corners: every edge then has a direction and every corner a turn."""
    corners = list(polygon)
    index = 0
    while len(corners) >= 3 and index < len(corners):
        before, here, after = corners[index - 1], corners[index], corners[(index + 1) % len(corners)]
        edge = hypot(here[0] - before[0], here[1] - before[1])
        chord = hypot(after[0] - before[0], after[1] - before[1])
        if (
            edge < MIN_CORNER_DISTANCE
            or chord < MIN_CORNER_DISTANCE
            or -_signed_distance(here, before, after) < MIN_CORNER_DISTANCE
        ):
            del corners[index]
            index = max(0, index - 1)
        else:
            index += 1
    return tuple(corners) if len(corners) >= 3 else ()
