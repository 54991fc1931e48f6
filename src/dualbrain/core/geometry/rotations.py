"""Rotations as quaternions, matrices and rotation vectors. Quaternions are unit (w, x, y, z); angles in radians."""

from __future__ import annotations

from collections.abc import Sequence
from math import atan2, sqrt

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def quaternion_to_matrix(quaternion: Sequence[float]) -> Array:
    """Rotation matrix (3, 3) of a quaternion, which need not be normalised."""
    return np.array(rotation_entries(quaternion)).reshape(3, 3)


def rotation_entries(quaternion: Sequence[float]) -> tuple[float, ...]:
    """The nine entries of `quaternion_to_matrix`, row by row; a third of its time."""
    w, x, y, z = quaternion
    s = 2.0 / (w * w + x * x + y * y + z * z)
    xx, yy, zz = x * x, y * y, z * z
    xy, xz, yz, wx, wy, wz = x * y, x * z, y * z, w * x, w * y, w * z
    return (
        *(1.0 - s * (yy + zz), s * (xy - wz), s * (xz + wy)),
        *(s * (xy + wz), 1.0 - s * (xx + zz), s * (yz - wx)),
        *(s * (xz - wy), s * (yz + wx), 1.0 - s * (xx + yy)),
    )


def matrix_to_quaternion(rotation: Array) -> tuple[float, float, float, float]:
    """Unit quaternion of a rotation matrix (3, 3), with w ≥ 0; stable at every angle (Shepperd's pivot, 1978)."""
    r = rotation
    squares = np.array([r[0, 0] + r[1, 1] + r[2, 2], r[0, 0], r[1, 1], r[2, 2]])
    pivot = int(np.argmax(squares))
    if pivot == 0:
        q = np.array([1.0 + squares[0], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    else:
        i = pivot - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q = np.empty(4)
        q[0] = r[k, j] - r[j, k]
        q[1 + i] = 1.0 + r[i, i] - r[j, j] - r[k, k]
        q[1 + j] = r[j, i] + r[i, j]
        q[1 + k] = r[k, i] + r[i, k]
    q /= np.linalg.norm(q)
    if q[0] < 0.0:
        q = -q
    return (float(q[0]), float(q[1]), float(q[2]), float(q[3]))


def rotation_error(current: Array, target: Array) -> Array:
    """Rotation vector (3,) in the world that turns `current` into `target`: log(target currentᵀ)."""
    turn = target @ current.T
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = turn.tolist()
    x, y, z = zy - yz, xz - zx, yx - xy
    sine = 0.5 * sqrt(x * x + y * y + z * z)
    cosine = 0.5 * (xx + yy + zz - 1.0)
    if sine < 1e-6 and cosine < 0.0:  # half a turn: the antisymmetric part vanishes
        w, *axis = matrix_to_quaternion(turn)
        return 2.0 * atan2(sqrt(max(0.0, 1.0 - w * w)), w) * np.asarray(axis)
    scale = 0.5 * atan2(sine, cosine) / sine if sine > 1e-12 else 0.5
    return np.array([scale * x, scale * y, scale * z])
