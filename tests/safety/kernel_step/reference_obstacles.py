"""What stands around a body, in numpy and float64 and from definitions: rows of the obstacle table by name."""

import numpy as np

from tests.safety.kernel_step.random_cases import BOX, CAPSULE, HALF_SPACE

FLOOR = 1e-3
"""[m] pairs nearer than this are always looked at."""
BEYOND = 10.0
"""[m] farther than any robot reaches."""


def ball(points, radii, shift):
    """Middle (from the first point), radius, inner distance: about the middle of the points' box, and a hair more."""
    if len(points) == 0:
        return np.zeros(5)
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    off, slack = np.linalg.norm(points - middle, axis=1), shift + 0.01 * FLOOR
    return np.array([*(middle - points[0]), (off + radii).max() + slack, (off - radii).min() + slack])


def off_segment(point, middle, axis, half):
    """Distance from a point to a segment."""
    along = np.clip((point - middle) @ axis, -half, half)
    return float(np.linalg.norm(point - middle - along * axis))


def separation_speed(reaction, brake, d, person):
    """v of d = v_h (T + v/a) + v T + v²/(2a), or 0."""
    late, spare = reaction + person / brake, d - person * reaction
    return brake * (np.sqrt(late * late + 2.0 * spare / brake) - late) if spare > 0.0 else 0.0


class Thing:
    """One row of the obstacle table by name, and the capsule around it."""

    def __init__(self, row, age):
        self.shape, self.flags, self.rank, self.mask = (int(x) for x in row[:4])
        self.alpha, self.radius, self.margin, self.error = row[4], row[20], row[24], row[25]
        self.turn, self.half, self.velocity = row[8:17].reshape(3, 3), row[17:20], row[21:24]
        self.reaction, self.brake, self.approach = row[26:29]
        self.start, self.place = row[5:8], row[5:8] + age * self.velocity
        self.speed = np.linalg.norm(self.velocity) + self.error
        self.plain = self.shape == CAPSULE and not self.brake > 0.0
        self.axis, self.length, self.thick = 2, self.half[2], self.radius
        if self.shape == BOX:
            self.axis = max(range(3), key=lambda e: (self.half[e], e == 2, -e))
            self.length = self.half[self.axis]
            self.thick = np.hypot(*np.delete(self.half, self.axis)) + 0.01 * FLOOR

    def gap(self, point):
        """Distance from a point to the capsule around the thing, or to a half-space."""
        if self.shape == HALF_SPACE:
            return float((point - self.place) @ self.turn[:, 2])
        return off_segment(point, self.place, self.turn[:, self.axis], self.length) - self.thick

    def distance(self, point):
        """Distance from a point to the thing itself, and the outward normal."""
        local = self.turn.T @ (point - self.place)
        if self.shape == HALF_SPACE:
            return local[2], self.turn[:, 2]
        inner = np.array([0.0, 0.0, self.half[2]]) if self.shape == CAPSULE else self.half
        away = local - np.clip(local, -inner, inner)
        d = np.linalg.norm(away)
        if self.shape == BOX and d <= 1e-6:  # leaves by the nearest face
            depth = np.abs(local) - self.half
            face = max(range(3), key=lambda e: (depth[e], e == 2, -e))
            return depth[face], self.turn[:, face] * (-1.0 if local[face] < 0.0 else 1.0)
        return d - self.radius, self.turn @ away / max(d, 1e-6)
