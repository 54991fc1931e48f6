"""dualbrain's `PolicyGuard`, which knows of the obstacles only what rendered depth images show."""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.guards.robot_interface import RobotInterface
from dualbrain.core.geometry.rotations import matrix_to_quaternion
from dualbrain.core.geometry.shapes import Pose
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.integration.point_clouds.pinhole_camera import PinholeCamera
from dualbrain.safety.integration.point_clouds.point_cloud_source import (
    CloudReport,
    PointCloudConfig,
    PointCloudSource,
)
from dualbrain.safety.integration.policy_guard.guard import PolicyGuard
from dualbrain.safety.integration.policy_guard.joint_actions import JointPosition
from dualbrain.safety.integration.scene_fusion import SceneFusion, SourceAccepted
from dualbrain.simulation.perception.rendering import OffscreenRenderer
from dualbrain.simulation.plant.plant import Plant

Array = NDArray[np.float64]

VIEWS = ("top", "front", "side")
WIDTH, HEIGHT = 212, 160
"""Size of the images [pixels]; a view is about 0.4 rad to 0.8 rad high."""
FRAME_PERIOD, MAX_AGE = 0.1, 0.25
"""Time between two images, and age at which the arm stops [s]."""
DEPTH_NOISE, DROPOUT = 0.001, 0.02
"""Standard deviation of a depth [m], and share of the pixels without a depth."""
WORKSPACE = ((-0.9, -0.9, 0.0), (0.9, 0.9, 1.3))
VOXEL = 0.025
UNKNOWN_OCCUPIED = {"unknown_is_occupied": True, "max_boxes": 96, "free_at_start": 0.25}
"""Settings with unknown space as an obstacle: its surface needs more boxes, and the arm begins in space that is hidden
from the cameras at the start."""
SOURCE = "depth cameras"


class DepthRenderer(OffscreenRenderer):
    """Depth images with noise of the plant's own cameras."""

    def __init__(self, plant: Plant, seed: int) -> None:
        """Open an offscreen GL context."""
        super().__init__(plant, WIDTH, HEIGHT)
        self._rng = np.random.default_rng([seed, 13])

    def capture(self, view: str) -> tuple[Array, PinholeCamera, Pose]:
        """The depth (height, width) [m], 0 where there is none, with calibration and pose of the camera."""
        model, data = self._plant.model, self._plant.data
        camera = int(model.camera(view).id)
        self._renderer.enable_depth_rendering()
        self._renderer.update_scene(data, view, self._option)
        depth = self._renderer.render().astype(float)
        depth += DEPTH_NOISE * self._rng.standard_normal(depth.shape)
        depth[self._rng.uniform(size=depth.shape) < DROPOUT] = 0.0
        focal = HEIGHT / (2.0 * np.tan(np.deg2rad(float(model.cam_fovy[camera])) / 2.0))
        centre = (0.5 * (WIDTH - 1), 0.5 * (HEIGHT - 1))
        intrinsics = PinholeCamera(width=WIDTH, height=HEIGHT, fx=focal, fy=focal, cx=centre[0], cy=centre[1])
        turn = data.cam_xmat[camera].reshape(3, 3) @ np.diag([1.0, -1.0, -1.0])  # MuJoCo looks along −z
        x, y, z = (float(value) for value in data.cam_xpos[camera])
        return depth, intrinsics, Pose((x, y, z), matrix_to_quaternion(turn))


class DepthGuard:
    """The whole arm behind `PolicyGuard`, with three depth cameras at 10 Hz; the table is known."""

    def __init__(
        self,
        robot_model: RobotModel,
        table: Obstacle,
        interface: RobotInterface,
        duration: float,
        plant: Plant,
        *,
        seed: int,
        unknown_is_occupied: bool,
    ) -> None:
        """Guard an arm at rest at the commanded posture of `interface`; the cameras are those of `plant`."""
        self._safety = SafetyFilter(robot_model, obstacles=[table])
        self._opening = float(robot_model.gripper.opening.value)
        self._guard = PolicyGuard(self._safety, JointPosition(), period=duration)
        self._guard.reset(interface.commanded)
        lower, upper = WORKSPACE
        unknown: dict[str, Any] = UNKNOWN_OCCUPIED if unknown_is_occupied else {}
        config = PointCloudConfig(lower=lower, upper=upper, voxel=VOXEL, **unknown)
        self._source = PointCloudSource(SOURCE, self._safety, config, [table])
        self._fusion = SceneFusion({SOURCE: self._source.scene_source(MAX_AGE)})
        self._cameras, self._last_frame = DepthRenderer(plant, seed), -np.inf
        self.reports: list[CloudReport] = []

    def begin(self, action: Array, q: Array, now: float) -> None:
        """Begin `action`, after new images if it is time."""
        if now - self._last_frame > FRAME_PERIOD - 1e-9:
            self._observe(q, now)
        self._fusion.apply_to(self._safety, now)
        self._guard.begin(action, now)

    def velocity(self, q: Array, v: Array, now: float) -> Array:
        """The safe control."""
        return self._guard.step(q, v, now, self._opening).u

    def close(self) -> None:
        """Release the renderer."""
        self._cameras.close()

    def _observe(self, q: Array, now: float) -> None:
        self._last_frame = now
        for view in VIEWS:
            depth, camera, pose = self._cameras.capture(view)
            report = self._source.observe_depth(depth, camera, pose, now, q, opening=self._opening, sensor=view)
            if report.problem:
                raise ValueError(f"{view}: {report.problem}")
            self.reports.append(report)
        accepted = self._fusion.update(SOURCE, "world", now, self.reports[-1].shapes, now=now)
        if not isinstance(accepted, SourceAccepted):
            raise TypeError(str(accepted))
