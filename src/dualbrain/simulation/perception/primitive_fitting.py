"""Fits upright primitives to coloured points: one box, cylinder or bowl for each cluster of points above the table.

Points within `CLUSTER_DISTANCE` of each other form one cluster. The highest points of a cluster give its height; their
outline is classified as a circle or a rectangle by the share of its bounding rectangle that it fills (a circle fills
π/4 of a square). A wide circle with a lower centre is a bowl. A colour is classified as the nearest known colour.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, KDTree, QhullError

from dualbrain.core.geometry.shapes import Bowl, Box, Cylinder, Pose, Quaternion
from dualbrain.simulation.scenes.colours import COLOUR_RGBA

Array = NDArray[np.float64]
MIN_POINT_HEIGHT = 0.006
"""Lower points belong to the table [m]."""
CLUSTER_DISTANCE, VOXEL_SIZE = 0.012, 0.004
"""Points nearer than the first belong to one cluster; one point is kept per cube with sides of the second [m]."""
MIN_CLUSTER_POINTS = 25
"""Smaller clusters are discarded."""
TOP_BAND = 0.007
"""Points within this distance of the top of a cluster form its outline [m]."""
MAX_ROUND_FILL, MAX_ROUND_ASPECT = 0.89, 1.25
"""An outline is a circle if it fills less than this share of its bounding rectangle, and the ratio of the rectangle's
sides is below the second value."""
MIN_BOWL_RADIUS, MIN_BOWL_DEPTH = 0.055, 0.012
"""A circle is a bowl if its radius is above the first [m] and its centre is lower than its rim by the second [m]."""
BOWL_WALL = 0.004
"""Assumed thickness of a bowl's wall [m]."""
COLOUR_GAIN, COLOUR_OFFSET = 1.12, 0.03
"""Camera response: shown = COLOUR_GAIN × colour + COLOUR_OFFSET, measured on one scene."""
OBJECT_COLOURS = (
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
    """One fitted object: an upright shape, its pose, its colour and the number of its points."""

    shape: Box | Cylinder | Bowl
    pose: Pose
    colour: str
    n_points: int


def fit_primitives(points: Array, colours: Array) -> list[Primitive]:
    """The primitives on the table in `points` (n, 3) [m] with `colours` (n, 3) in [0, 1]."""
    above = points[:, 2] > MIN_POINT_HEIGHT
    points, colours = _voxel_downsample(points[above], colours[above])
    fitted = [fit_primitive(points[indices], colours[indices]) for indices in _clusters(points)]
    return [one for one in fitted if one is not None]


def fit_primitive(points: Array, colours: Array) -> Primitive | None:
    """The upright primitive for one cluster of `points` (n, 3) [m]; None if its top has no outline."""
    top = float(np.quantile(points[:, 2], 0.98))
    high = points[:, 2] > top - TOP_BAND
    plane = points[high, :2]
    if len(plane) < MIN_CLUSTER_POINTS // 3:
        return None
    try:
        hull = ConvexHull(plane)
    except QhullError:
        return None
    corners = plane[hull.vertices]
    middle, sides, yaw = _min_area_rectangle(corners)
    colour = nearest_colour(np.median(colours[high], axis=0))
    share = float(hull.volume) / float(sides[0] * sides[1])
    if share < MAX_ROUND_FILL and max(sides) < MAX_ROUND_ASPECT * min(sides):
        centre, radius = _fit_circle(corners)
        return _fit_round(centre, radius, top, points, colour)
    shape = Box((float(sides[0]) / 2, float(sides[1]) / 2, top / 2))
    return Primitive(shape, _upright_pose(middle, top / 2, yaw), colour, len(points))


def nearest_colour(seen: Array) -> str:
    """The known colour whose camera response is nearest to the observed colour `seen` (3,)."""
    shown = {
        name: np.clip(COLOUR_GAIN * np.array(COLOUR_RGBA[name][:3]) + COLOUR_OFFSET, 0.0, 1.0)
        for name in OBJECT_COLOURS
    }
    return min(shown, key=lambda name: float(np.linalg.norm(shown[name] - seen)))


def _fit_round(centre: Array, radius: float, top: float, points: Array, colour: str) -> Primitive:
    """A cylinder, or a bowl if it is wide and hollow."""
    inner = points[np.linalg.norm(points[:, :2] - centre, axis=1) < 0.6 * radius]
    hollow = len(inner) > 0 and float(np.median(inner[:, 2])) < top - MIN_BOWL_DEPTH
    if radius > MIN_BOWL_RADIUS and hollow:
        return Primitive(Bowl(radius, top, BOWL_WALL), _upright_pose(centre, 0.0, 0.0), colour, len(points))
    return Primitive(Cylinder(radius, top / 2), _upright_pose(centre, top / 2, 0.0), colour, len(points))


def _voxel_downsample(points: Array, colours: Array) -> tuple[Array, Array]:
    """One point for each cube with sides of `VOXEL_SIZE`."""
    _, first = np.unique(np.floor(points / VOXEL_SIZE).astype(int), axis=0, return_index=True)
    return points[first], colours[first]


def _clusters(points: Array) -> Iterator[NDArray[np.intp]]:
    """The indices of the points of each cluster."""
    if not len(points):
        return
    pairs = KDTree(points).sparse_distance_matrix(KDTree(points), CLUSTER_DISTANCE)
    count, label = connected_components(pairs, directed=False)
    for number in range(count):
        indices = np.flatnonzero(label == number)
        if len(indices) >= MIN_CLUSTER_POINTS:
            yield indices


def _min_area_rectangle(corners: Array) -> tuple[Array, Array, float]:
    """The smallest rectangle around a convex outline (k, 2): centre (2,), sides (2,) [m], yaw [rad] in (−π/4, π/4]."""
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


def _fit_circle(corners: Array) -> tuple[Array, float]:
    """The least-squares circle through an outline (k, 2): centre (2,), radius [m] (Kåsa 1976)."""
    rows = np.column_stack([2.0 * corners, np.ones(len(corners))])
    x, y, c = np.linalg.lstsq(rows, (corners**2).sum(axis=1), rcond=None)[0]
    return np.array([x, y]), float(np.sqrt(max(c + x * x + y * y, 1e-9)))


def _upright_pose(middle: Array, height: float, yaw: float) -> Pose:
    turn: Quaternion = (float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2)))
    return Pose((float(middle[0]), float(middle[1]), height), turn)
