"""Random Fourier features of the posture (q, opening): unit vectors whose cosine approximates a Gaussian kernel."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache
from math import pi

import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError
from dualbrain.robots.model import RobotModel

Array = NDArray[np.float64]

MAX_FLOOR_COORDINATE = 10.0
"""Floor coordinates are clipped to ± this value [m]."""


@dataclass(frozen=True, slots=True)
class Posture:
    """Joint angles `q` [rad] and `opening` of each finger [m] when the instruction was received.

    An unknown opening (None) counts as fully open.
    """

    q: tuple[float, ...]
    opening: float | None


@dataclass(frozen=True, slots=True)
class PostureLimits:
    """Ranges that normalise the postures of `robot`: joint angles [rad] and the largest opening of each finger [m]."""

    robot: str
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    opening: float

    @classmethod
    def from_model(cls, robot_model: RobotModel) -> PostureLimits:
        """The limits of `robot_model`; x and y of a mobile base are limited to ±10 m, its heading to ±π rad."""
        lower = tuple(joint.lower.value for joint in robot_model.joints)
        upper = tuple(joint.upper.value for joint in robot_model.joints)
        if robot_model.is_mobile:
            lower, upper = (
                (-MAX_FLOOR_COORDINATE, -MAX_FLOOR_COORDINATE, -pi, *lower[2:]),
                (MAX_FLOOR_COORDINATE, MAX_FLOOR_COORDINATE, pi, *upper[2:]),
            )
        return cls(robot_model.name, lower, upper, robot_model.gripper.opening.value)

    def normalize(self, posture: Posture) -> Array:
        """Point in [−1, 1]^(n+1): each joint and the opening, scaled linearly between its limits and clipped.

        Raises `ConfigurationError` for another number of joints and for values that are not finite.
        """
        opening = self.opening if posture.opening is None else posture.opening
        if len(posture.q) != len(self.lower) or not np.isfinite([*posture.q, opening]).all():
            raise ConfigurationError(
                "posture", got=posture, allowed=f"{len(self.lower)} finite joint angles of {self.robot}"
            )
        x = np.array([*posture.q, opening])
        lower, upper = np.array([*self.lower, 0.0]), np.array([*self.upper, self.opening or 1.0])
        return np.clip(2.0 * (x - lower) / (upper - lower) - 1.0, -1.0, 1.0)

    @property
    def fingerprint(self) -> str:
        """Eight hex digits that change when a limit changes."""
        text = ",".join(value.hex() for value in (*self.lower, *self.upper, self.opening))
        return hashlib.sha256(text.encode()).hexdigest()[:8]


def fourier_features(x: Array, features: int, seed: int, bandwidth: float) -> Array:
    """z(x) = √(2/D)·[cos Ωx, sin Ωx] of shape (D,), with D = `features`; ‖z‖ = 1 exactly.

    z(x)·z(y) ≈ exp(−‖x − y‖² / 2·bandwidth²) (Rahimi & Recht 2007). The rows of Ω are orthogonal (Yu et al. 2016),
    which halves the error to about 0.02 on average at 128 features.
    """
    phase = _frequencies(x.size, features // 2, seed) @ x / bandwidth
    return np.concatenate([np.cos(phase), np.sin(phase)]) / np.sqrt(features // 2)


@lru_cache
def _frequencies(dim: int, rows: int, seed: int) -> Array:
    """Ω of shape (rows, dim): blocks of orthogonal directions; each row has the length of a Gaussian vector."""
    blocks = -(-rows // dim)
    gaussian = _standard_normals(seed, 2 * blocks * dim * dim).reshape(2, blocks, dim, dim)
    directions = [_signed_q_factor(block) for block in gaussian[0]]
    lengths = np.linalg.norm(gaussian[1].reshape(blocks * dim, dim), axis=1)
    return (np.vstack(directions) * lengths[:, None])[:rows]


def orthogonal_rows(rows: int, dim: int, seed: int) -> Array:
    """Orthonormal rows of shape (rows, dim), uniformly distributed; the same on every machine."""
    gaussian = _standard_normals(seed, rows * dim).reshape(rows, dim)
    q, r = np.linalg.qr(gaussian.T)
    return (q * np.sign(np.diag(r))).T


def _signed_q_factor(block: Array) -> Array:
    """The Q factor, transposed, whose R has a positive diagonal: this choice of signs is the same in every LAPACK."""
    q, r = np.linalg.qr(block)
    return (q * np.sign(np.diag(r))).T


def _standard_normals(seed: int, count: int) -> Array:
    """`count` standard normals from SHAKE-256 and the Box-Muller transform; the same with every machine and NumPy.

    NumPy does not promise that the streams of its generators stay the same, and stored vectors must stay valid under
    later versions.
    """
    raw = hashlib.shake_256(f"dualbrain posture features {seed}".encode()).digest(16 * count)
    uniform = (np.frombuffer(raw, "<u8") >> np.uint64(11)).astype(np.float64) * 2.0**-53
    radius = np.sqrt(-2.0 * np.log1p(-uniform[:count]))
    return radius * np.cos(2.0 * np.pi * uniform[count:])
