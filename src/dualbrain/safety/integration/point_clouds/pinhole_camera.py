"""Calibration of a depth camera, and the two directions of its projection.

A pixel in column i and row j with depth z [m] along the optical axis is the point
((i − c_x) z / f_x, (j − c_y) z / f_y, z) in the optical frame: x to the right, y down, z forward, as in ROS and OpenCV.
"""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry import validation
from dualbrain.errors import GeometryError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
MAX_PIXELS = 8192
"""Largest width and height [pixels]."""


class PinholeCamera(msgspec.Struct, frozen=True, kw_only=True):
    """An undistorted camera: `width` and `height`, focal lengths `fx`, `fy` and centre `cx`, `cy`, all in pixels.

    Depths beyond `max_depth` [m] are not used. Raises `GeometryError` for a value that is not usable.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    max_depth: float = 4.0

    def __post_init__(self) -> None:
        """Check the values."""
        for name in ("width", "height"):
            value = getattr(self, name)
            if type(value) is not int or not 0 < value <= MAX_PIXELS:
                raise GeometryError(f"PinholeCamera.{name} [pixels]", got=value, allowed=f"1 to {MAX_PIXELS}")
        for name in ("fx", "fy", "max_depth"):
            validation.check_positive(f"PinholeCamera.{name}", getattr(self, name), 1e6)
        for name in ("cx", "cy"):
            validation.check_number(f"PinholeCamera.{name} [pixels]", getattr(self, name), -1e6, 1e6)

    def valid_pixels(self, depth: Array) -> Mask:
        """Which pixels of `depth` (height, width) [m] hold a measurement; 0 and NaN mean none."""
        return np.isfinite(depth) & (depth > 0.0) & (depth <= self.max_depth)

    def back_project(self, depth: Array, used: Mask) -> Array:
        """The points (n, 3) [m] in the optical frame of the pixels `used` (height, width) of `depth` [m]."""
        rows, columns = np.nonzero(used)
        z = depth[rows, columns]
        return np.column_stack([(columns - self.cx) * z / self.fx, (rows - self.cy) * z / self.fy, z])

    def project(self, points: Array) -> tuple[NDArray[np.intp], NDArray[np.intp], Mask]:
        """Row and column of each of `points` (n, 3) [m] in the optical frame, and which of them are in the image."""
        z = points[:, 2]
        ahead = np.where(z > 1e-6, z, np.inf)
        columns = np.rint(points[:, 0] * self.fx / ahead + self.cx)
        rows = np.rint(points[:, 1] * self.fy / ahead + self.cy)
        inside = (z > 1e-6) & (columns >= 0) & (columns < self.width) & (rows >= 0) & (rows < self.height)
        return np.where(inside, rows, 0).astype(np.intp), np.where(inside, columns, 0).astype(np.intp), inside
