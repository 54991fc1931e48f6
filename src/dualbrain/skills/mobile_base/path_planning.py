"""Path planning on the floor: shortest path on a grid around perceived objects, then straightened.

The path only determines where φ drives; the filter keeps its distances independently. People are excluded: the filter
and the waiting of the base controller account for them.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.distance import bounding_solid, signed_distance
from dualbrain.core.geometry.shapes import HalfSpace
from dualbrain.records import Scene
from dualbrain.skills.time_slicing import SlicedComputation, run_to_completion

Array = NDArray[np.float64]
FreeCells = NDArray[np.bool_]

CELL_SIZE = 0.08
"""Edge length of a grid cell [m]."""
ROWS_PER_STEP = 8
"""Rows of the grid whose clearance is computed in one step."""
CLEARANCES = (0.30, 0.15, 0.05)
"""Clearance beyond the footprint [m]: the preferred value, then smaller ones if no path is found."""
NEIGHBOURS = [(a, b, float(np.hypot(a, b))) for a in (-1, 0, 1) for b in (-1, 0, 1) if (a, b) != (0, 0)]


def plan_path(scene: Scene, start: Array, end: Array, radius: float) -> SlicedComputation[list[Array] | None]:
    """Waypoints (2,) [m] from `start` to `end` for a disc of `radius` [m], or None if there is no path.

    Objects may be closer to the start than the clearance.
    """
    corner, shape = _grid_frame(scene, start, end)
    centres = corner + CELL_SIZE * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
    distance = np.empty(shape)
    for rows in (slice(first, first + ROWS_PER_STEP) for first in range(0, shape[0], ROWS_PER_STEP)):
        distance[rows] = yield from _clearance(scene, centres[rows])
    distance[np.linalg.norm(centres - start, axis=-1) < 0.4] += radius
    for margin in CLEARANCES:
        cells = yield from _search(distance > radius + margin, _cell(start, corner), _cell(end, corner))
        if cells is not None:
            points = [start, *(corner + CELL_SIZE * np.array(cell) for cell in cells[1:-1]), end]
            return (yield from _straighten(points, scene, radius + 0.8 * margin))
    return None


def clearance(scene: Scene, points: Array) -> Array:
    """Distance [m] of `points` (..., 2) from objects and from the edge of the region, minus errors."""
    return run_to_completion(_clearance(scene, points))


def _clearance(scene: Scene, points: Array) -> SlicedComputation[Array]:
    flat = np.concatenate([points, np.zeros((*points.shape[:-1], 1))], axis=-1)
    least = np.full(points.shape[:-1], np.inf)
    for obj in scene.objects:
        if obj.role != "person" and not isinstance(obj.shape, HalfSpace):
            yield
            least = np.minimum(least, signed_distance(*bounding_solid(obj.shape, obj.pose), flat) - obj.error)
    for index, (x, y) in enumerate(scene.region):
        along = np.subtract(scene.region[(index + 1) % len(scene.region)], (x, y))
        inward = np.array([-along[1], along[0]]) / np.linalg.norm(along)
        least = np.minimum(least, (points - (x, y)) @ inward)
    return least


def _grid_frame(scene: Scene, start: Array, end: Array) -> tuple[Array, tuple[int, int]]:
    corners = np.array(scene.region) if scene.region else np.array([start - 3.0, start + 3.0, end - 3.0, end + 3.0])
    low, high = corners.min(axis=0), corners.max(axis=0)
    size = np.ceil((high - low) / CELL_SIZE).astype(int) + 1
    return low, (int(size[0]), int(size[1]))


def _cell(point: Array, corner: Array) -> tuple[int, int]:
    a, b = np.round((point - corner) / CELL_SIZE).astype(int).tolist()
    return a, b


def _search(
    free: FreeCells, start: tuple[int, int], end: tuple[int, int]
) -> SlicedComputation[list[tuple[int, int]] | None]:
    """A* search: the cells of a shortest path, including both ends, or None."""
    if not (_in_grid(free, start) and _in_grid(free, end) and free[end]):
        return None
    best, came = {start: 0.0}, dict[tuple[int, int], tuple[int, int]]()
    queue = [(0.0, start)]
    while queue:
        yield
        _, here = heapq.heappop(queue)
        if here == end:
            way = [here]
            while here in came:
                here = came[here]
                way.append(here)
            return way[::-1]
        for a, b, length in NEIGHBOURS:
            there = (here[0] + a, here[1] + b)
            if not _in_grid(free, there) or not free[there]:
                continue
            cost = best[here] + length
            if cost < best.get(there, np.inf):
                best[there], came[there] = cost, here
                ahead = float(np.hypot(there[0] - end[0], there[1] - end[1]))
                heapq.heappush(queue, (cost + ahead, there))
    return None


def _in_grid(free: FreeCells, cell: tuple[int, int]) -> bool:
    return 0 <= cell[0] < free.shape[0] and 0 <= cell[1] < free.shape[1]


def _straighten(points: Sequence[Array], scene: Scene, min_clearance: float) -> SlicedComputation[list[Array]]:
    """The points that remain if every section with enough clearance is replaced by a straight line."""
    kept, at = [points[0]], 0
    while at < len(points) - 1:
        after = len(points) - 1
        while after > at + 1 and not (yield from _is_clear(points[at], points[after], scene, min_clearance)):
            after -= 1
        kept.append(points[after])
        at = after
    return kept


def _is_clear(start: Array, end: Array, scene: Scene, min_clearance: float) -> SlicedComputation[bool]:
    count = max(2, int(np.linalg.norm(end - start) / (0.5 * CELL_SIZE)))
    line = start + np.linspace(0.0, 1.0, count)[:, None] * (end - start)
    far = np.linalg.norm(line - start, axis=1) > 0.4
    distance = yield from _clearance(scene, line)
    return bool(np.all(distance[far] > min_clearance))
