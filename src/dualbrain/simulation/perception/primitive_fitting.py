"""Coloured points become upright primitives: clusters of what stands on the table, each fitted by its top face.

Points above the table that lie within `TOUCH` of each other are one thing. Its height is that of its highest points;
the outline of those highest points is a circle or a rectangle, whichever the outline fills better (a circle fills π/4
of the square around it); a wide ring with a lower middle is a bowl. Colours are told by the nearest of those known.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, KDTree, QhullError

from dualbrain.core.geometry.shapes import Bowl, Box, Cylinder, Pose, Quaternion
from dualbrain.simulation.scenes.appearance import COLOURS

Array = NDArray[np.float64]
FLOOR = 0.006
"""Points lower than this belong to the table [m]."""
TOUCH, CELL = 0.012, 0.004
"""Points nearer than the first are one thing; one point is kept per cube of the second [m]."""
FEWEST = 25
"""Points that make a thing."""
RIM = 0.007
"""The highest points of a thing lie within this of its top [m]."""
ROUND, ALMOST_SQUARE = 0.89, 1.25
"""An outline that fills less of its rectangle than the first, with sides in a ratio below the second, is a circle."""
WIDE, HOLLOW = 0.055, 0.012
"""A circle wider than the first [m] whose middle lies lower than its rim by more than the second [m] is a bowl."""
WALL = 0.004
"""Thickness of a bowl's wall, as of those in stock [m]."""
EXPOSURE, LIFT = 1.12, 0.03
"""How brightly the cameras show a colour: seen = EXPOSURE × colour + LIFT, measured on one scene."""
THINGS = (
    "red",
    "blue",
    "green",
    "yellow",
    "orange",
    "purple",
    "teal",
    "white",
    "brown",
    "grey",
    "pink",
    "black",
    "clear",
)


@dataclass(frozen=True, slots=True)
class Primitive:
    """One thing as seen: an upright shape, where it is, its colour, and how many points say so."""

    shape: Box | Cylinder | Bowl
    pose: Pose
    colour: str
    points: int


def primitives(points: Array, colours: Array) -> list[Primitive]:
    """What stands on the table among `points` (n, 3) [m] with `colours` (n, 3) in [0, 1]."""
    up = points[:, 2] > FLOOR
    kept, tints = _thinned(points[up], colours[up])
    found = [fit(kept[mine], tints[mine]) for mine in _clusters(kept)]
    return [one for one in found if one is not None]


def fit(points: Array, colours: Array) -> Primitive | None:
    """The upright primitive of one cluster; None where its top has no outline."""
    top = float(np.quantile(points[:, 2], 0.98))
    high = points[:, 2] > top - RIM
    plane = points[high, :2]
    if len(plane) < FEWEST // 3:
        return None
    try:
        hull = ConvexHull(plane)
    except QhullError:
        return None
    corners = plane[hull.vertices]
    middle, sides, yaw = _rectangle(corners)
    colour = colour_name(np.median(colours[high], axis=0))
    share = float(hull.volume) / float(sides[0] * sides[1])
    if share < ROUND and max(sides) < ALMOST_SQUARE * min(sides):
        centre, radius = _circle(corners)
        return _round(centre, radius, top, points, colour)
    shape = Box((float(sides[0]) / 2, float(sides[1]) / 2, top / 2))
    return Primitive(shape, _standing(middle, top / 2, yaw), colour, len(points))


def colour_name(seen: Array) -> str:
    """The known colour that a camera would show most like `seen` (3,)."""
    shown = {name: np.clip(EXPOSURE * np.array(COLOURS[name][:3]) + LIFT, 0.0, 1.0) for name in THINGS}
    return min(shown, key=lambda name: float(np.linalg.norm(shown[name] - seen)))


def _round(centre: Array, radius: float, top: float, points: Array, colour: str) -> Primitive:
    """A cylinder, or a bowl where a wide one is hollow."""
    inner = points[np.linalg.norm(points[:, :2] - centre, axis=1) < 0.6 * radius]
    hollow = len(inner) > 0 and float(np.median(inner[:, 2])) < top - HOLLOW
    if radius > WIDE and hollow:
        return Primitive(Bowl(radius, top, WALL), _standing(centre, 0.0, 0.0), colour, len(points))
    return Primitive(Cylinder(radius, top / 2), _standing(centre, top / 2, 0.0), colour, len(points))


def _thinned(points: Array, colours: Array) -> tuple[Array, Array]:
    """One point a cube of side `CELL`."""
    _, first = np.unique(np.floor(points / CELL).astype(int), axis=0, return_index=True)
    return points[first], colours[first]


def _clusters(points: Array) -> Iterator[NDArray[np.intp]]:
    """Indices of each cluster."""
    if not len(points):
        return
    pairs = KDTree(points).sparse_distance_matrix(KDTree(points), TOUCH)
    count, label = connected_components(pairs, directed=False)
    for number in range(count):
        mine = np.flatnonzero(label == number)
        if len(mine) >= FEWEST:
            yield mine


def _rectangle(corners: Array) -> tuple[Array, Array, float]:
    """The least rectangle around a convex outline (k, 2): middle (2,), sides (2,) [m], yaw [rad] in (−π/4, π/4]."""
    edges = np.roll(corners, -1, axis=0) - corners
    best: tuple[float, Array, Array, float] | None = None
    for angle in np.arctan2(edges[:, 1], edges[:, 0]):
        yaw = float((angle + np.pi / 4) % (np.pi / 2) - np.pi / 4)
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        turned = corners @ turn
        low, high = turned.min(axis=0), turned.max(axis=0)
        area = float(np.prod(high - low))
        if best is None or area < best[0]:
            best = (area, turn @ ((low + high) / 2), high - low, yaw)
    assert best is not None
    return best[1:]


def _circle(corners: Array) -> tuple[Array, float]:
    """The circle of least squares through an outline (k, 2): centre (2,), radius [m] (Kåsa 1976)."""
    rows = np.column_stack([2.0 * corners, np.ones(len(corners))])
    x, y, c = np.linalg.lstsq(rows, (corners**2).sum(axis=1), rcond=None)[0]
    return np.array([x, y]), float(np.sqrt(max(c + x * x + y * y, 1e-9)))


def _standing(middle: Array, height: float, yaw: float) -> Pose:
    turn: Quaternion = (float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2)))
    return Pose((float(middle[0]), float(middle[1]), height), turn)
