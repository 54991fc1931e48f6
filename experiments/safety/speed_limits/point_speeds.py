"""Positions and speeds of the parts of an arm in float64, from its robot model alone and for many states at once."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.model import RobotModel
from experiments.safety.reference_judge import rotation_matrix

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PointSpeeds:
    """The centres of all spheres that joints move, of the spheres `held` (k, 4) in the tool frame, and the tool.

    The joints are revolute, and the fingers are closed.
    """

    robot_model: RobotModel
    held: Array = field(default_factory=lambda: np.zeros((0, 4)))

    def measure(self, q: Array, u: Array) -> tuple[Array, Array]:
        """Positions (t, k, 3) [m] and speeds (t, k) [m/s] at the postures q (t, n) and joint velocities u (t, n)."""
        positions, velocities = self._move(q, u)
        return positions, np.linalg.norm(velocities, axis=2)

    def jacobians(self, q: Array) -> Array:
        """Jacobians (k, 3, n) [m/rad] of the points at the posture q (n,)."""
        units = np.eye(self.robot_model.n)
        return np.moveaxis(self._move(np.broadcast_to(q, units.shape), units)[1], 0, 2)

    def _move(self, q: Array, u: Array) -> tuple[Array, Array]:
        """Positions and velocities (t, k, 3) of the points."""
        positions, velocities = [], []
        for frame, (turn, origin, spin, velocity) in enumerate(self._frames(q, u)):
            points = self._points(frame)
            if len(points) == 0:
                continue
            arms = points @ np.swapaxes(turn, 1, 2)
            positions.append(origin[:, None] + arms)
            velocities.append(velocity[:, None] + np.cross(spin[:, None], arms))
        return np.concatenate(positions, axis=1), np.concatenate(velocities, axis=1)

    def radii(self) -> Array:
        """Radii (k,) [m] of the points in the order of `measure`; the tool is a point."""
        frames = range(1, self.robot_model.n + 1)
        return np.concatenate([[radius for *_, radius in self._spheres(frame)] for frame in frames])

    def _points(self, frame: int) -> Array:
        return np.array([one[:3] for one in self._spheres(frame)]) if frame else np.zeros((0, 3))

    def _spheres(self, frame: int) -> list[tuple[float, float, float, float]]:
        """Centres and radii of the spheres that move with a joint, in its frame."""
        found = list[tuple[float, float, float, float]]()
        tool = self.robot_model.tool
        for link in self.robot_model.links:
            if link.frame != frame:
                continue
            turn, shift = rotation_matrix(link.quaternion), np.array(link.translation)
            for sphere in (one for one in self.robot_model.spheres if one.link == link.name):
                found.append((*(shift + turn @ np.array(sphere.centre)), sphere.radius))
            if link.name == tool.link:
                origin = shift + turn @ np.array(tool.translation)
                axes = turn @ rotation_matrix(tool.quaternion)
                found += [(*(origin + axes @ one[:3]), float(one[3])) for one in self.held]
                found.append((*origin, 0.0))
        return found

    def _frames(self, q: Array, u: Array) -> list[tuple[Array, Array, Array, Array]]:
        """Rotation, origin, angular velocity and velocity of the base frame and of the frame of each joint."""
        count = len(q)
        turn, origin = np.broadcast_to(np.eye(3), (count, 3, 3)), np.zeros((count, 3))
        spin, velocity = np.zeros((count, 3)), np.zeros((count, 3))
        found = [(turn, origin, spin, velocity)]
        for k, joint in enumerate(self.robot_model.joints):
            arm = turn @ np.array(joint.translation)
            origin, velocity = origin + arm, velocity + np.cross(spin, arm)
            turn = turn @ rotation_matrix(joint.quaternion) @ _about_z(q[:, k])
            spin = spin + turn[:, :, 2] * u[:, k, None]
            found.append((turn, origin, spin, velocity))
        return found


def _about_z(angle: Array) -> Array:
    """Rotations (t, 3, 3) about z by `angle` (t,) [rad]."""
    turn = np.zeros((len(angle), 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(angle)
    turn[:, 1, 0] = np.sin(angle)
    turn[:, 0, 1] = -turn[:, 1, 0]
    turn[:, 2, 2] = 1.0
    return turn
