"""Calibrated RGB-D cameras: coloured points in the world frame, without points on the robot itself.

A pixel (i, j) with depth d [m] along the optical axis is the point p = c + R (x d, y d, −d), x = (j + ½ − w/2)/f,
y = (h/2 − i − ½)/f, f = h / (2 tan(fovy/2)). Every depth has independent noise. Points within the robot's own collision
spheres at the measured joint positions are removed. The camera never reads which object a pixel shows.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.simulation.perception.rendering import OffscreenRenderer
from dualbrain.simulation.plant.plant import Plant

Array = NDArray[np.float64]
CAMERA_VIEWS = ("top", "front", "side")
MAX_DEPTH = 4.0
"""Larger depths are discarded [m]."""
DEPTH_NOISE = 0.0005
"""Standard deviation of a depth value [m]."""
SELF_FILTER_MARGIN = 0.02
"""Points within this distance of one of the robot's own spheres count as the robot [m]."""


class DepthCamera(OffscreenRenderer):
    """Several RGB-D cameras on one plant; close it, or use it in a `with` block."""

    def __init__(
        self,
        plant: Plant,
        *,
        width: int = 320,
        height: int = 240,
        noise: float = DEPTH_NOISE,
        rng: np.random.Generator | None = None,
    ) -> None:
        """Open an offscreen GL context; raises `MissingDependencyError`, which names the packages to install.

        `noise` [m] is the standard deviation of a depth value, drawn from `rng` (default: a generator with seed 0).
        """
        super().__init__(plant, width, height)
        self._filter = SafetyFilter(plant.robot_model)
        self._noise, self._rng = noise, np.random.default_rng(0) if rng is None else rng
        self._rays = {view: self._ray_directions(view, width, height) for view in CAMERA_VIEWS}

    def capture_points(self, min_height: float = -MAX_DEPTH) -> tuple[Array, Array]:
        """The points (n, 3) [m] in the world frame that the cameras see now, and their colours (n, 3) in [0, 1].

        Only points above `min_height` [m] are returned, because most pixels show the table or the floor.
        """
        views = [self._capture_view(view) for view in CAMERA_VIEWS]
        points, colours = (np.concatenate(parts) for parts in zip(*views, strict=True))
        high = points[:, 2] > min_height
        points, colours = points[high], colours[high]
        keep = ~self._robot_mask(points)
        return points[keep], colours[keep]

    def _ray_directions(self, view: str, width: int, height: int) -> Array:
        """Rays (n_pixels, 3) of unit depth in the camera frame: x right, y up, optical axis −z."""
        camera = int(self._plant.model.camera(view).id)
        focal = height / (2.0 * np.tan(np.deg2rad(float(self._plant.model.cam_fovy[camera])) / 2.0))
        column, row = np.meshgrid(np.arange(width) + 0.5 - width / 2, height / 2 - np.arange(height) - 0.5)
        return np.column_stack([column.ravel() / focal, row.ravel() / focal, -np.ones(column.size)])

    def _capture_view(self, view: str) -> tuple[Array, Array]:
        camera, data, renderer = self._plant.model.camera(view).id, self._plant.data, self._renderer
        renderer.update_scene(data, view, self._option)
        colours = renderer.render().reshape(-1, 3) / 255.0
        renderer.enable_depth_rendering()
        renderer.update_scene(data, view, self._option)
        depth = renderer.render().ravel().astype(float)
        renderer.disable_depth_rendering()
        near = depth < MAX_DEPTH
        depth += self._noise * self._rng.standard_normal(len(depth))
        rotation = data.cam_xmat[camera].reshape(3, 3)
        return data.cam_xpos[camera] + (self._rays[view][near] * depth[near, None]) @ rotation.T, colours[near]

    def _robot_mask(self, points: Array) -> NDArray[np.bool_]:
        """Which of `points` (n, 3) [m] are on the robot itself, shape (n,)."""
        q = self._plant.data.qpos[self._plant.arm_slices[0]].copy()
        opened = self._plant.robot_model.gripper.opening.value
        own = [self._filter.spheres(q, share * opened)[:2] for share in (0.0, 0.5, 1.0)]  # any finger position
        centres, radii = (np.concatenate(parts) for parts in zip(*own, strict=True))
        squared = (points**2).sum(axis=1)[:, None] - 2.0 * points @ centres.T + (centres**2).sum(axis=1)
        return (squared < (radii + SELF_FILTER_MARGIN) ** 2).any(axis=1)
