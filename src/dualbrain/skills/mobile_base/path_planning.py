"""A way over the floor: shortest on a grid around what is perceived, then pulled straight.

It only chooses where φ drives; the filter keeps its distances whatever is chosen here. Moving people are left out:
where they will be is the filter's business, and the chassis's own waiting.
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
"""Grid [m]."""
ROWS_PER_STEP = 8
"""Rows of the grid that are looked at in one glance."""
CLEARANCES = (0.30, 0.15, 0.05)
"""Air [m] beyond the footprint that is asked for, then what is made do with."""
NEIGHBOURS = [(a, b, float(np.hypot(a, b))) for a in (-1, 0, 1) for b in (-1, 0, 1) if (a, b) != (0, 0)]


def plan_path(scene: Scene, start: Array, end: Array, radius: float) -> SlicedComputation[list[Array] | None]:
    """Points (2,) [m] from `start` to `end`, that a disc of `radius` [m] may pass; None where none leads there.

    The start itself may be as near to things as it is.
    """
    corner, shape = _grid_frame(scene, start, end)
    centres = corner + CELL_SIZE * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
    room = np.empty(shape)
    for rows in (slice(first, first + ROWS_PER_STEP) for first in range(0, shape[0], ROWS_PER_STEP)):
        room[rows] = yield from _clearance(scene, centres[rows])
    room[np.linalg.norm(centres - start, axis=-1) < 0.4] += radius
    for air in CLEARANCES:
        cells = yield from _search(room > radius + air, _cell(start, corner), _cell(end, corner))
        if cells is not None:
            points = [start, *(corner + CELL_SIZE * np.array(cell) for cell in cells[1:-1]), end]
            return (yield from _straighten(points, scene, radius + 0.8 * air))
    return None


def clearance(scene: Scene, points: Array) -> Array:
    """Distance [m] of `points` (..., 2) from what stands and from the edge of the region, errors taken off."""
    return run_to_completion(_clearance(scene, points))


def _clearance(scene: Scene, points: Array) -> SlicedComputation[Array]:
    flat = np.concatenate([points, np.zeros((*points.shape[:-1], 1))], axis=-1)
    least = np.full(points.shape[:-1], np.inf)
    for thing in scene.objects:
        if thing.role != "person" and not isinstance(thing.shape, HalfSpace):
            yield
            least = np.minimum(least, signed_distance(*bounding_solid(thing.shape, thing.pose), flat) - thing.error)
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
    """A*: the cells of a shortest way, both ends included."""
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
    """The points that are left when every stretch that has room is driven straight."""
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
    air = yield from _clearance(scene, line)
    return bool(np.all(air[far] > min_clearance))
