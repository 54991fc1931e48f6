"""The common problem: an arm of revolute joints covered by spheres, among obstacles. Requires only numpy.

The processes of all filters import this file in their environments. It is also the reference in float64: rows of
the plain control barrier function, n'J_s u ≥ −α (h − margin), and the box |u| ≤ v_max,
−α (q − q_lower) ≤ u ≤ α (q_upper − q).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

SPHERE, CAPSULE, BOX = 0, 1, 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """Geometry and limits; lengths in m, angles in rad. Frame 0 is the base, frame i follows joint i.

    `joint_rotation` (n, 3, 3) and `joint_offset` (n, 3): parent to joint at q = 0; the joint axis is its own z axis.
    Spheres: `sphere_frame` (k,), `sphere_centre` (k, 3) in that frame, `sphere_radius` (k,). Obstacles: `kind` (m,),
    `position` (m, 3), `rotation` (m, 3, 3), `half` (m, 3), `radius` (m,); the axis of a capsule is its z axis with
    half length half[2].
    """

    joint_rotation: np.ndarray
    joint_offset: np.ndarray
    q_lower: np.ndarray
    q_upper: np.ndarray
    v_max: np.ndarray
    a_max: np.ndarray
    home: np.ndarray
    sphere_frame: np.ndarray
    sphere_centre: np.ndarray
    sphere_radius: np.ndarray
    kind: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    half: np.ndarray
    radius: np.ndarray
    alpha: float
    period: float
    whole_body: bool

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joint_offset)

    @property
    def n_pairs(self) -> int:
        """Number of pairs of a moving sphere and an obstacle."""
        return int(np.count_nonzero(self.sphere_frame)) * len(self.kind)

    def save(self, path: str) -> None:
        """Write the problem to a .npz file."""
        np.savez(path, **asdict(self))


def load(path: str) -> Problem:
    """Read the problem from the .npz file `path`."""
    with np.load(path) as data:
        values: dict[str, Any] = {name: data[name] for name in data.files}
    for name in ("alpha", "period"):
        values[name] = float(values[name])
    return Problem(**(values | {"whole_body": bool(values["whole_body"])}))


def frames(problem: Problem, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations (n + 1, 3, 3) and origins (n + 1, 3) of all frames at joint angles q (n,)."""
    R, p = np.eye(3), np.zeros(3)
    rotations, origins = [R], [p]
    for k in range(problem.n):
        p = p + R @ problem.joint_offset[k]
        c, s = np.cos(q[k]), np.sin(q[k])
        R = R @ problem.joint_rotation[k] @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        rotations.append(R)
        origins.append(p)
    return np.array(rotations), np.array(origins)


def centres(problem: Problem, q: np.ndarray) -> np.ndarray:
    """Return sphere centres (k, 3) [m]."""
    rotations, origins = frames(problem, q)
    at = problem.sphere_frame
    return origins[at] + np.einsum("kij,kj->ki", rotations[at], problem.sphere_centre)


def jacobians(problem: Problem, q: np.ndarray) -> np.ndarray:
    """Return the Jacobians of the sphere centres (k, 3, n)."""
    rotations, origins = frames(problem, q)
    lever = centres(problem, q)[:, None, :] - origins[None, 1:, :]
    columns = np.cross(rotations[None, 1:, :, 2], lever)
    moves = np.arange(1, problem.n + 1)[None, :] <= problem.sphere_frame[:, None]
    return np.swapaxes(columns * moves[:, :, None], 1, 2)


def distances(problem: Problem, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return exact distances (k, m) from points (k, 3) to all obstacle surfaces [m], and outward normals (k, m, 3)."""
    local = np.einsum("mji,kmj->kmi", problem.rotation, points[:, None, :] - problem.position[None])
    core = np.clip(local, -problem.half, problem.half)
    offset = local - core
    size = np.linalg.norm(offset, axis=2)
    inside = problem.half - np.abs(local)
    face = np.argmin(inside, axis=2)
    out = np.eye(3)[face] * np.where(local >= 0.0, 1.0, -1.0)
    buried = size < 1e-12
    d = np.where(buried, -np.min(inside, axis=2), size) - problem.radius
    normal = np.where(buried[..., None], out, offset / np.maximum(size, 1e-12)[..., None])
    return d, np.einsum("mij,kmj->kmi", problem.rotation, normal)


def clearances(problem: Problem, q: np.ndarray) -> np.ndarray:
    """Return h of every moving sphere and obstacle (moving spheres, m) [m]."""
    moving = problem.sphere_frame > 0
    return distances(problem, centres(problem, q)[moving])[0] - problem.sphere_radius[moving, None]


def barrier_rows(
    problem: Problem, q: np.ndarray, *, margin: float = 0.0, near: float = np.inf
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A (rows, n), b (rows,) and h (rows,) of all pairs with h < `near` [m]."""
    moving = problem.sphere_frame > 0
    d, normal = distances(problem, centres(problem, q)[moving])
    h = d - problem.sphere_radius[moving, None]
    s, o = np.nonzero(h < near)
    A = np.einsum("ri,rij->rj", normal[s, o], jacobians(problem, q)[moving][s])
    return A, -problem.alpha * (h[s, o] - margin), h[s, o]


def control_bounds(problem: Problem, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return lower and upper controls (n,): velocity limits, and at most α times the distance to a joint limit."""
    lower = np.maximum(-problem.v_max, -problem.alpha * (q - problem.q_lower))
    upper = np.minimum(problem.v_max, problem.alpha * (problem.q_upper - q))
    return lower, upper
