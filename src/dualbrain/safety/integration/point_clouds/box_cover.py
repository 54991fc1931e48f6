"""Few boxes that together contain all occupied voxels, small where a large box would cost the robot clearance.

The boxes are the leaves of a tree: the first one is the bounding box of all voxels. The leaf that costs most is divided
at the middle of its longest side, until there are `limit` leaves. The cost of a leaf is the clearance that its box
takes from a sphere of the robot, d(voxels) − d(box), with less weight for a box far away, because the filter does not
react to it. No voxel is left out, so the filter keeps the same distance from all of them as from the boxes.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
NEAR_DISTANCE = 0.1
"""Distance [m] at which the lost clearance has half its weight."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BoxCover:
    """Corners `low` and `high` (k, 3) [m] of the boxes.

    `clearance` [m] is the least distance between voxels and robot, `lost` [m] the largest share of it that the boxes
    take from one sphere of the robot.
    """

    low: Array
    high: Array
    clearance: float
    lost: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _Leaf:
    voxels: Indices
    low: Array
    high: Array
    distance: Array
    """Distance of the box from each sphere (m,) [m]."""
    cost: float


def cover_voxels(centres: Array, voxel: float, spheres: Array, radii: Array, *, limit: int) -> BoxCover:
    """At most `limit` boxes that contain the cubes with sides `voxel` [m] at `centres` (n, 3) [m].

    `spheres` (m, 3) [m] and `radii` (m,) [m] are those of the robot.
    """
    if not len(centres):
        return BoxCover(low=np.zeros((0, 3)), high=np.zeros((0, 3)), clearance=np.inf, lost=0.0)
    half = 0.5 * voxel
    distances = box_distances(centres - half, centres + half, spheres, radii)

    def leaf(voxels: Indices) -> _Leaf:
        part = centres[voxels]
        low, high = part.min(axis=0) - half, part.max(axis=0) + half
        distance = box_distances(low[None], high[None], spheres, radii)[0]
        lost = distances[voxels].min(axis=0) - distance
        weight = NEAR_DISTANCE / (NEAR_DISTANCE + np.maximum(distance, 0.0))
        cost = float(np.max(lost * weight))
        return _Leaf(voxels=voxels, low=low, high=high, distance=distance, cost=cost)

    leaves = _divide(leaf(np.arange(len(centres))), leaf, centres, limit)
    true = distances.min(axis=0)
    lost = true - np.min([one.distance for one in leaves], axis=0)
    return BoxCover(
        low=np.array([one.low for one in leaves]),
        high=np.array([one.high for one in leaves]),
        clearance=float(true.min()),
        lost=float(lost.max()),
    )


def _divide(root: _Leaf, leaf: Callable[[Indices], _Leaf], centres: Array, limit: int) -> list[_Leaf]:
    """The leaves after division of the most expensive ones; a leaf of one voxel costs nothing."""
    count = 0
    queue: list[tuple[float, int, _Leaf]] = [(-root.cost, count, root)]
    while len(queue) < limit and queue[0][2].cost > 1e-9:
        one = heapq.heappop(queue)[2]
        axis = int(np.argmax(one.high - one.low))
        lower = centres[one.voxels, axis] < 0.5 * (one.low[axis] + one.high[axis])
        for part in (one.voxels[lower], one.voxels[~lower]):
            count += 1
            child = leaf(part)
            heapq.heappush(queue, (-child.cost, count, child))
    return [one for _, _, one in queue]


def box_distances(low: Array, high: Array, spheres: Array, radii: Array) -> Array:
    """Distance (n, m) [m] of the boxes with corners `low`, `high` (n, 3) from spheres (m, 3) with `radii` (m,).

    A sphere whose centre is in a box has minus its radius.
    """
    squared = np.zeros((len(low), len(spheres)))
    for axis in range(3):
        x = spheres[None, :, axis]
        outside = np.maximum(np.maximum(low[:, axis, None] - x, x - high[:, axis, None]), 0.0)
        squared += outside * outside
    return np.sqrt(squared) - radii
