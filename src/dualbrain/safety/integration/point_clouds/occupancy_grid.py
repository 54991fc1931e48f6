"""Voxels of the workspace that are free, occupied or unknown, as depth sensors have seen them.

A voxel that contains a measured point is occupied, until a sensor sees through it. A voxel that the arm or another
object hides keeps its state, so that an obstacle does not disappear when the arm moves in front of the camera. Free
voxels that no sensor has seen for longer than the memory are unknown.
"""

from __future__ import annotations

from enum import IntEnum
from math import inf, prod

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry import validation
from dualbrain.core.geometry.shapes import Vector
from dualbrain.errors import GeometryError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
MAX_VOXELS = 2_000_000
"""Largest number of voxels of a grid (1.2 m × 1.6 m × 1 m at 1 cm)."""
MAX_RAY_STEPS = 400
"""Largest number of steps along one ray."""


class VoxelState(IntEnum):
    """The last knowledge about a voxel."""

    UNKNOWN = 0
    FREE = 1
    OCCUPIED = 2


class OccupancyGrid:
    """Cubes with sides of `voxel` [m] between the corners `lower` and `upper` [m] of a box in the world."""

    def __init__(self, lower: Vector, upper: Vector, voxel: float, memory: float = inf) -> None:
        """Start with unknown voxels; `memory` [s] limits how long a free voxel counts as free without being seen.

        Raises `GeometryError` if the box is empty or has more than `MAX_VOXELS` voxels.
        """
        low = np.array(validation.check_vector("lower [m]", lower))
        high = np.array(validation.check_vector("upper [m]", upper))
        self.voxel = validation.check_positive("voxel [m]", voxel, 1.0)
        if not np.all(high - low >= self.voxel):
            raise GeometryError("upper [m]", got=upper, allowed=f"at least one voxel above lower, {lower}")
        n = [int(count) for count in np.ceil((high - low) / self.voxel - 1e-9)]
        if prod(n) > MAX_VOXELS:
            fix = "Use larger voxels or a smaller box."
            raise GeometryError("voxels", got=prod(n), allowed=f"at most {MAX_VOXELS}", fix=fix)
        self._low, self._counts, self._memory = low, (n[0], n[1], n[2]), memory
        cells = np.moveaxis(np.indices(n), 0, -1).reshape(-1, 3)
        self.centres = np.asarray(low + self.voxel * (cells + 0.5), np.float64)
        self.state = np.zeros(len(self.centres), np.uint8)
        self._seen_free = np.full(len(self.centres), -inf)
        self._seen_occupied = np.full(len(self.centres), -inf)

    @property
    def half_diagonal(self) -> float:
        """Distance from the centre of a voxel to its corners [m]."""
        return 0.5 * np.sqrt(3.0) * self.voxel

    def contains(self, points: Array) -> Mask:
        """Which of `points` (n, 3) [m] are in the box."""
        cells = self._cells(points)
        return np.all((cells >= 0) & (cells < self._counts), axis=1)

    def index(self, points: Array) -> NDArray[np.intp]:
        """The voxel of each of `points` (n, 3) [m], which are in the box."""
        return self._flat(self._cells(points).astype(np.intp))

    def within_spheres(self, spheres: Array, radii: Array) -> NDArray[np.intp]:
        """The voxels whose centre is within `radii` (m,) [m] of `spheres` (m, 3) [m]."""
        found = [np.zeros(0, np.intp)]
        cube = self.centres.reshape(*self._counts, 3)
        for sphere, radius in zip(spheres, radii, strict=True):
            first = np.clip(self._cells(sphere - radius).astype(int), 0, self._counts)
            last = np.clip(self._cells(sphere + radius).astype(int) + 1, 0, self._counts)
            block = cube[tuple(slice(a, b) for a, b in zip(first, last, strict=True))]
            cells = np.argwhere(((block - sphere) ** 2).sum(axis=-1) <= radius * radius) + first
            found.append(self._flat(cells))
        return np.unique(np.concatenate(found))

    def mark_free(self, voxels: Mask | NDArray[np.intp], stamp: float) -> None:
        """A sensor has seen through `voxels`, or the robot itself is there, at `stamp` [s].

        Voxels that were seen as occupied after `stamp` stay occupied.
        """
        chosen = np.flatnonzero(voxels) if voxels.dtype == np.bool_ else voxels
        freed = chosen[(self.state[chosen] != VoxelState.OCCUPIED) | (self._seen_occupied[chosen] <= stamp)]
        self.state[freed] = VoxelState.FREE
        self._seen_free[freed] = np.maximum(self._seen_free[freed], stamp)

    def mark_occupied(self, points: Array, min_points: int = 1, *, stamp: float = -inf) -> None:
        """Voxels with at least `min_points` of the `points` (n, 3) [m], measured at `stamp` [s], are occupied."""
        found, counts = np.unique(self.index(points[self.contains(points)]), return_counts=True)
        occupied = found[counts >= min_points]
        self.state[occupied] = VoxelState.OCCUPIED
        self._seen_occupied[occupied] = np.maximum(self._seen_occupied[occupied], stamp)

    def forget_times(self) -> None:
        """Stamps belong to another clock from now on: with a memory, free voxels become unknown; occupied ones stay."""
        self._seen_free[:], self._seen_occupied[:] = -inf, -inf
        if self._memory < inf:
            self.state[self.state == VoxelState.FREE] = VoxelState.UNKNOWN

    def see_through_rays(self, origin: Array, points: Array, stamp: float) -> None:
        """Voxels on the rays from `origin` (3,) [m] to `points` (n, 3) [m] are free, except for their last voxels.

        One ray for each voxel with a point and for each direction beyond the box is sampled at half a voxel.
        """
        if not len(points):
            return
        _, kept = np.unique(np.floor(points / self.voxel), axis=0, return_index=True)
        ways = points[kept] - origin
        lengths = np.linalg.norm(ways, axis=1)
        steps = np.arange(MAX_RAY_STEPS) * 0.5 * self.voxel
        ends = lengths[:, None] - 2.0 * self.half_diagonal
        shares = steps[None] / np.maximum(lengths, 1e-9)[:, None]
        samples = (origin + shares[..., None] * ways[:, None])[steps[None] < ends]
        self.mark_free(np.unique(self.index(samples[self.contains(samples)])), stamp)

    def forget(self, now: float) -> None:
        """Free voxels that were not seen within the memory become unknown."""
        self.state[(self.state == VoxelState.FREE) & (now - self._seen_free > self._memory)] = VoxelState.UNKNOWN

    def occupied(self) -> Array:
        """Centres (n, 3) [m] of the occupied voxels."""
        return self.centres[self.state == VoxelState.OCCUPIED]

    def unknown_frontier(self) -> Array:
        """Centres (n, 3) [m] of the unknown voxels with a free neighbour: the surface of unknown space."""
        cube = self.state.reshape(self._counts)
        free = np.pad(cube == VoxelState.FREE, 1)
        beside = np.zeros_like(cube, bool)
        for axis in range(3):
            for shift in (-1, 1):
                beside |= np.roll(free, shift, axis)[1:-1, 1:-1, 1:-1]
        return self.centres[((cube == VoxelState.UNKNOWN) & beside).ravel()]

    def _flat(self, cells: NDArray[np.intp]) -> NDArray[np.intp]:
        """Numbers of the voxels with these coordinates (n, 3)."""
        return (cells[:, 0] * self._counts[1] + cells[:, 1]) * self._counts[2] + cells[:, 2]

    def _cells(self, points: Array) -> Array:
        """Whole-numbered coordinates of `points` in the grid, which may be outside."""
        return np.floor((points - self._low) / self.voxel)
