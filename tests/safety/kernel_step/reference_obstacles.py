"""Reference of the obstacle table and of distances in numpy and float64, from their definitions."""

import numpy as np

from tests.safety.kernel_step.random_cases import BOX, CAPSULE, HALF_SPACE

ALWAYS_CHECKED_DISTANCE = 1e-3
"""Pairs closer than this are always checked [m]."""
MAX_DISTANCE = 10.0
"""Distance beyond the reach of any robot [m]."""


def bounding_sphere(points, radii, shift):
    """Centre (relative to the first point) of the points' bounding box; radius, inner distance, radius of points."""
    if len(points) == 0:
        return np.zeros(6)
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    off, slack = np.linalg.norm(points - middle, axis=1), shift + 0.01 * ALWAYS_CHECKED_DISTANCE
    around = (off + radii).max() + slack, (off - radii).min() + slack, off.max() + slack
    return np.array([*(middle - points[0]), *around])


def segment_distance(point, middle, axis, half):
    """Distance from a point to a segment."""
    along = np.clip((point - middle) @ axis, -half, half)
    return float(np.linalg.norm(point - middle - along * axis))


def separation_speed(reaction, brake, d, person):
    """The v of d = v_h (T + v/a) + v T + v²/(2a), or 0."""
    late, spare = reaction + person / brake, d - person * reaction
    return brake * (np.sqrt(late * late + 2.0 * spare / brake) - late) if spare > 0.0 else 0.0


class ReferenceObstacle:
    """One row of the obstacle table with named fields, and the capsule around it."""

    def __init__(self, row, age):
        self.shape, self.flags, self.rank, self.mask = (int(x) for x in row[:4])
        self.alpha, self.radius, self.margin, self.velocity_error = row[4], row[20], row[24], row[25]
        self.rotation, self.half, self.velocity = row[8:17].reshape(3, 3), row[17:20], row[21:24]
        self.reaction, self.brake, self.approach = row[26:29]
        self.start_position, self.position = row[5:8], row[5:8] + age * self.velocity
        self.speed = np.linalg.norm(self.velocity) + self.velocity_error
        self.is_plain_capsule = self.shape == CAPSULE and not self.brake > 0.0
        self.axis, self.length, self.capsule_radius = 2, self.half[2], self.radius
        if self.shape == BOX:
            self.axis = max(range(3), key=lambda e: (self.half[e], e == 2, -e))
            self.length = self.half[self.axis]
            self.capsule_radius = np.hypot(*np.delete(self.half, self.axis)) + 0.01 * ALWAYS_CHECKED_DISTANCE

    def capsule_distance(self, point):
        """Distance from a point to the capsule around the obstacle, or to a half-space."""
        if self.shape == HALF_SPACE:
            return float((point - self.position) @ self.rotation[:, 2])
        return segment_distance(point, self.position, self.rotation[:, self.axis], self.length) - self.capsule_radius

    def distance(self, point):
        """Distance from a point to the obstacle itself, and the outward normal."""
        local = self.rotation.T @ (point - self.position)
        if self.shape == HALF_SPACE:
            return local[2], self.rotation[:, 2]
        inner = np.array([0.0, 0.0, self.half[2]]) if self.shape == CAPSULE else self.half
        away = local - np.clip(local, -inner, inner)
        d = np.linalg.norm(away)
        if self.shape == BOX and d <= 1e-6:  # leave by the nearest face
            depth = np.abs(local) - self.half
            face = max(range(3), key=lambda e: (depth[e], e == 2, -e))
            return depth[face], self.rotation[:, face] * (-1.0 if local[face] < 0.0 else 1.0)
        return d - self.radius, self.rotation @ away / max(d, 1e-6)
