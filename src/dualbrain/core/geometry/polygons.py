"""What two convex polygons have in common."""

from __future__ import annotations

from math import hypot

Point = tuple[float, float]

MIN_CORNER_DISTANCE = 1e-3
"""A corner that is nearer than this to another, or to the line past it [m], is none."""


def intersect_convex(one: tuple[Point, ...], other: tuple[Point, ...]) -> tuple[Point, ...]:
    """The corners of `one` ∩ `other`, both convex and counter-clockwise; () where they share no floor.

    `one` is cut along every edge of `other` (Sutherland and Hodgman, 1974). Leaving out what is hardly a corner only
    makes the polygon smaller.
    """
    left = one
    for a, b in zip(other, other[1:] + other[:1], strict=True):
        left = _clip(left, a, b)
    return _drop_degenerate_corners(left)


def _signed_distance(point: Point, a: Point, b: Point) -> float:
    """Distance [m] of `point` to the left of the line from `a` to `b`."""
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
    """Without corners that hardly are any, so that every edge has a direction and every corner a turn."""
    left = list(polygon)
    index = 0
    while len(left) >= 3 and index < len(left):
        before, here, after = left[index - 1], left[index], left[(index + 1) % len(left)]
        apart = hypot(here[0] - before[0], here[1] - before[1])
        across = hypot(after[0] - before[0], after[1] - before[1])
        if (
            apart < MIN_CORNER_DISTANCE
            or across < MIN_CORNER_DISTANCE
            or -_signed_distance(here, before, after) < MIN_CORNER_DISTANCE
        ):
            del left[index]
            index = max(0, index - 1)
        else:
            index += 1
    return tuple(left) if len(left) >= 3 else ()
