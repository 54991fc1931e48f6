"""robot-dam as a compared guard: a process in its own environment answers one safe target per action."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.guards.guards.guard import TargetGuard
from benchmarks.guards.guards.robot_dam.environment import ENVIRONMENT
from benchmarks.guards.robot_interface import RobotInterface
from dualbrain.core.geometry.shapes import Box, Capsule, Sphere
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.obstacles import Obstacle
from experiments.safety.reference_judge import rotation_matrix

Array = NDArray[np.float64]
ToolKinematics = Callable[[Array], tuple[Array, Array]]
"""Position (3,) [m] and Jacobian (3, n) of the tool at q (n,)."""

HAND_RADIUS = 0.08
"""Inflation of the keep-out spheres for the extent of the hand, of which robot-dam knows only the tool point [m]."""
TOOL_HEIGHT = 0.02
"""Smallest height of the tool point above the table [m]."""
WORKSPACE = ((-1.0, 1.0), (-1.0, 1.0), (TOOL_HEIGHT, 1.5))
SPHERE_SPACING = 0.05
"""Distance between the keep-out spheres that cover a capsule or a box [m]."""


class RobotDam(TargetGuard):
    """robot-dam's workspace, keep-out spheres, joint ranges and speed limits, once per action as in its products."""

    def __init__(
        self,
        robot_model: RobotModel,
        obstacles: Sequence[Obstacle],
        interface: RobotInterface,
        duration: float,
        tool: ToolKinematics,
    ) -> None:
        """Start robot-dam; `tool` provides the kinematics, so that no error of a description is charged to it."""
        super().__init__(interface, duration)
        self._tool = tool
        self._process = subprocess.Popen(
            [str(ENVIRONMENT.interpreter()), str(Path(__file__).with_name("worker.py"))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": ""},
        )
        setup = {
            "period": duration,
            "workspace": WORKSPACE,
            "spheres": [row for obstacle in obstacles[1:] for row in keep_out_spheres(obstacle)],
            "lower": [joint.lower.value for joint in robot_model.joints],
            "upper": [joint.upper.value for joint in robot_model.joints],
            "v_max": [joint.velocity.value for joint in robot_model.joints],
        }
        self._request(setup)

    def safe_target(self, action: Array, q: Array) -> Array:
        """The answer of robot-dam."""
        position, jacobian = self._tool(q)
        request = {"action": action, "q": q, "position": position, "jacobian": jacobian}
        return np.array(json.loads(self._request({name: value.tolist() for name, value in request.items()})))

    def close(self) -> None:
        """End the process."""
        self._process.communicate()

    def _request(self, content: dict[str, Any]) -> str:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(content) + "\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        if not answer:
            raise RuntimeError("robot-dam has ended; its message is on stderr")
        return answer


def keep_out_spheres(obstacle: Obstacle) -> list[list[float]]:
    """Spheres (x, y, z, radius) that cover the obstacle, inflated by the extent of the hand."""
    turn, centre = rotation_matrix(obstacle.pose.quaternion), np.array(obstacle.pose.position)
    match obstacle.shape:
        case Sphere(radius=radius):
            local, cover = np.zeros((1, 3)), radius
        case Capsule(radius=radius, half_length=length):
            along = _grid(length)
            local, cover = np.column_stack([0.0 * along, 0.0 * along, along]), np.hypot(radius, SPHERE_SPACING / 2.0)
        case Box(half_extents=extents):
            axes = [_grid(max(extent - SPHERE_SPACING / 2.0, 0.0)) for extent in extents]
            local = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
            cover = SPHERE_SPACING / 2.0 * np.sqrt(3.0)
        case _:
            raise ValueError(f"robot-dam has no keep-out zone of this shape: {obstacle.shape}")
    return [[*(centre + turn @ point).tolist(), float(cover + HAND_RADIUS)] for point in local]


def _grid(half: float) -> Array:
    """Points of [−half, half] at most `SPHERE_SPACING` apart."""
    return (
        np.linspace(-half, half, max(2, int(np.ceil(2.0 * half / SPHERE_SPACING)) + 1)) if half > 0.0 else np.zeros(1)
    )
