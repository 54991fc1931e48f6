"""A calibrated RGB-D camera: coloured points in the world, without the robot's own body.

A pixel (i, j) with depth d [m] along the optical axis lies at p = c + R (x d, y d, −d), x = (j + ½ − w/2)/f,
y = (h/2 − i − ½)/f, f = h / (2 tan(fovy/2)). Every depth has noise of its own, as a sensor's has. What is known of the
robot is taken out: points within its own spheres at the measured joint angles. Nothing here reads which thing a pixel
shows.
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
"""Depth beyond which nothing is used [m]."""
DEPTH_NOISE = 0.0005
"""Standard deviation of a depth [m]."""
SELF_FILTER_MARGIN = 0.02
"""Points this near to one of the robot's own spheres count as the robot [m]."""


class DepthCamera(OffscreenRenderer):
    """Looks at one plant from several sides; close it, or use it in a `with` block."""

    def __init__(
        self,
        plant: Plant,
        *,
        width: int = 320,
        height: int = 240,
        noise: float = DEPTH_NOISE,
        rng: np.random.Generator | None = None,
    ) -> None:
        """Open an offscreen GL context; raises `MissingPart` with the packages to install when there is none.

        `noise` [m] is the standard deviation of a depth, its chance comes from `rng` (none: always the same).
        """
        super().__init__(plant, width, height)
        self._filter = SafetyFilter(plant.robot_model)
        self._noise, self._rng = noise, np.random.default_rng(0) if rng is None else rng
        self._rays = {view: self._ray_directions(view, width, height) for view in CAMERA_VIEWS}

    def capture_points(self, min_height: float = -MAX_DEPTH) -> tuple[Array, Array]:
        """What the cameras see now: points (n, 3) [m] in the world, and their colours (n, 3) in [0, 1].

        Only those higher than `above` [m]: most of a picture is table and floor.
        """
        seen = [self._capture_view(view) for view in CAMERA_VIEWS]
        points, colours = (np.concatenate(parts) for parts in zip(*seen, strict=True))
        high = points[:, 2] > min_height
        points, colours = points[high], colours[high]
        keep = ~self._robot_mask(points)
        return points[keep], colours[keep]

    def _ray_directions(self, view: str, width: int, height: int) -> Array:
        """Rays (pixels, 3) of unit depth in the camera's own frame: x right, y up, looking along −z."""
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
        """Which points lie on the robot itself."""
        q = self._plant.data.qpos[self._plant.arm_slices[0]].copy()
        opened = self._plant.robot_model.gripper.opening.value
        own = [self._filter.spheres(q, share * opened)[:2] for share in (0.0, 0.5, 1.0)]  # wherever the fingers are
        centres, radii = (np.concatenate(parts) for parts in zip(*own, strict=True))
        apart = (points**2).sum(axis=1)[:, None] - 2.0 * points @ centres.T + (centres**2).sum(axis=1)
        return (apart < (radii + SELF_FILTER_MARGIN) ** 2).any(axis=1)
