"""Where every sphere of a body is, how it moves, and how it accelerates when no joint does; numpy, float64."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.robots.model import RobotModel

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class SphereMotion(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """All spheres at one state: c̈ = J q̈ + J̇ q̇.

    `centres`, `velocities` J q̇ and `bias` J̇ q̇ are (k, 3) in m, m/s, m/s²; `spins` (k, 3) [rad/s] are the angular
    velocities of the spheres' frames; `jacobian` is (k, n, 3) and `levers` (k, n) holds the lengths of its columns.
    """

    centres: Array
    velocities: Array
    bias: Array
    angular_velocities: Array
    jacobian: Array
    lever_lengths: Array


class SphereKinematics:
    """The spheres of a body on its chain: frame 0 is the base, frame i moves with joint i."""

    def __init__(self, robot_model: RobotModel) -> None:
        """Read the chain and lay out the spheres in the order of the links."""
        self.n = robot_model.n
        self._joint_transforms = [
            (quaternion_to_matrix(joint.quaternion), np.array(joint.translation)) for joint in robot_model.joints
        ]
        self._prismatic = np.array([joint.kind == "prismatic" for joint in robot_model.joints])
        parts = [(link, ball) for link in robot_model.links for ball in robot_model.spheres if ball.link == link.name]
        turns = [quaternion_to_matrix(link.quaternion) for link, _ in parts]
        self.names = tuple(link.name for link, _ in parts)
        self.groups = tuple(link.group for link, _ in parts)
        self.radii = np.array([ball.radius for _, ball in parts])
        self.frames: Index = np.array([link.frame for link, _ in parts])
        self._local = np.array(
            [
                np.array(link.translation) + turn @ np.array(ball.centre)
                for (link, ball), turn in zip(parts, turns, strict=True)
            ]
        )
        self._finger_slide = np.array(
            [turn @ np.array(link.slide) for (link, _), turn in zip(parts, turns, strict=True)]
        )
        self._moved_by = np.arange(1, self.n + 1) <= self.frames[:, None]
        self.max_levers = self._max_levers(robot_model)

    def _max_levers(self, robot_model: RobotModel) -> Array:
        """(k, n): the longest lever that sphere k can have about joint j, over all postures [m]; 1 for a slide."""
        travel = np.array([max(abs(j.lower.value), abs(j.upper.value)) for j in robot_model.joints]) * self._prismatic
        steps = np.array([np.linalg.norm(joint.translation) for joint in robot_model.joints]) + travel
        along = np.concatenate([[0.0], np.cumsum(steps)])
        tip = np.linalg.norm(self._local, axis=1) + robot_model.gripper.opening.value * np.linalg.norm(
            self._finger_slide, axis=1
        )
        reach = along[self.frames][:, None] - along[1:] + tip[:, None]
        return np.where(self._prismatic, 1.0, reach) * self._moved_by

    def on_link(self, link: str) -> list[int]:
        """The spheres of a link."""
        return [i for i, name in enumerate(self.names) if name == link]

    def frame_of(self, sphere: int) -> int:
        """The frame that a sphere rides on."""
        return int(self.frames[sphere])

    def frame_poses(self, q: Array) -> tuple[Array, Array]:
        """Rotations (n + 1, 3, 3) and origins (n + 1, 3) of the frames at joint positions q (n,)."""
        turns, origins = np.empty((self.n + 1, 3, 3)), np.empty((self.n + 1, 3))
        turns[0], origins[0] = np.eye(3), 0.0
        for j, (turn, shift) in enumerate(self._joint_transforms):
            here = turns[j] @ turn
            origins[j + 1] = origins[j] + turns[j] @ shift
            if self._prismatic[j]:
                turns[j + 1] = here
                origins[j + 1] += here[:, 2] * q[j]
            else:
                c, s = np.cos(q[j]), np.sin(q[j])
                turns[j + 1, :, 0] = c * here[:, 0] + s * here[:, 1]
                turns[j + 1, :, 1] = c * here[:, 1] - s * here[:, 0]
                turns[j + 1, :, 2] = here[:, 2]
        return turns, origins

    def motion(self, q: Array, v: Array, opening: float) -> SphereMotion:
        """Motion of all spheres at joint positions q and velocities v, each (n,); the fingers count as standing still.

        A frame's twist at the world's origin is (Ω, B) with ċ = Ω × c + B; both are sums over the joints before it, and
        so are their derivatives with ż_j = Ω_{j−1} × z_j and ṗ_j = Ω_{j−1} × p_j + B_{j−1}.
        """
        turns, origins = self.frame_poses(q)
        local = self._local + opening * self._finger_slide
        c = origins[self.frames] + np.einsum("kij,kj->ki", turns[self.frames], local)
        z, p, turning, rate = turns[1:, :, 2], origins[1:], ~self._prismatic[:, None], v[:, None]
        moment = np.where(turning, cross(p, z), z)
        spin, drift = _prefix_sums(turning * z * rate), _prefix_sums(moment * rate)
        z_dot, p_dot = cross(spin[:-1], z), cross(spin[:-1], p) + drift[:-1]
        moment_dot = np.where(turning, cross(p_dot, z) + cross(p, z_dot), z_dot)
        spin_dot, drift_dot = _prefix_sums(turning * z_dot * rate), _prefix_sums(moment_dot * rate)
        of = self.frames
        c_dot = cross(spin[of], c) + drift[of]
        bias = cross(spin_dot[of], c) + cross(spin[of], c_dot) + drift_dot[of]
        columns = np.where(turning, cross(z, c[:, None] - p), z) * self._moved_by[:, :, None]
        return SphereMotion(
            centres=c,
            velocities=c_dot,
            bias=bias,
            angular_velocities=spin[of],
            jacobian=columns,
            lever_lengths=np.sqrt(np.einsum("kni,kni->kn", columns, columns)),
        )


def cross(a: Array, b: Array) -> Array:
    """The product a × b over the last axis, with broadcasting."""
    a1, a2, a3 = a[..., 0], a[..., 1], a[..., 2]
    b1, b2, b3 = b[..., 0], b[..., 1], b[..., 2]
    x = a2 * b3 - a3 * b2
    product = np.empty((*x.shape, 3))
    product[..., 0], product[..., 1], product[..., 2] = x, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1
    return product


def _prefix_sums(rows: Array) -> Array:
    """(n + 1, 3): the sum of the first i rows for i = 0..n."""
    return np.concatenate([np.zeros((1, 3)), np.cumsum(rows, axis=0)])
