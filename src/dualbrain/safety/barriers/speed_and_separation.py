"""separation: speed toward a person falls with the distance so that the robot stops before they meet."""

from __future__ import annotations

from math import sqrt

import numpy as np

from dualbrain.core.geometry.shapes import Capsule, Pose
from dualbrain.safety.barriers.barrier import Array, Barrier, Trial
from dualbrain.safety.barriers.scenarios import arm_filter, centres, home, tool_push
from dualbrain.safety.cbf.obstacles import Obstacle, Separation
from dualbrain.safety.cbf.rows import Rank

PLACE = (0.85, 0.0, 0.45)
RADIUS, HALF = 0.08, 0.3


def greatest_speed(distance: float, person: float, reaction: float, brake: float) -> float:
    """The speed v with d = v_h (T_r + T_s) + v T_r + v²/(2a), T_s = v/a [m/s]; 0 when d < v_h T_r."""
    spare = distance - person * reaction
    late = reaction + person / brake
    return brake * (sqrt(late * late + 2.0 * spare / brake) - late) if spare > 0.0 else 0.0


def _trial() -> Trial:
    safety = arm_filter()
    apart = Separation(reaction=0.1, brake=1.0, approach=0.2)
    person = Obstacle(
        "person", Capsule(RADIUS, HALF), Pose(PLACE), rank=Rank.BODY, separation=apart, barrier="separation"
    )
    safety.observe([person])

    def gap(q: Array) -> Array:
        where, radii = centres(safety, q)
        axis = np.column_stack([np.full(len(where), PLACE[0]), np.zeros(len(where)), where[:, 2]])
        axis[:, 2] = np.clip(where[:, 2], PLACE[2] - HALF, PLACE[2] + HALF)
        return np.linalg.norm(where - axis, axis=1) - radii - RADIUS

    def h(q: Array, u: Array) -> float:
        """Room to the allowed speed, over all spheres; a thousandth is for the margins of rows."""
        dt = 1e-3
        near, far = gap(q), gap(q + dt * u)
        toward = (near - far) / dt
        allowed = [greatest_speed(d, apart.approach, apart.reaction, apart.brake) for d in near]
        return float(np.min(np.array(allowed) - toward) + 2e-3)

    return Trial(safety, home(safety), tool_push(safety, (1.0, 0.0, 0.0)), h)


BARRIER = Barrier(
    name="separation",
    says="the speed toward a person leaves room to stop before they meet, whoever keeps moving",
    h="v_max(d) less the speed toward the person",
    row="n'J u ≥ −v_max(d), v_max = a (√((T_r + v_h/a)² + 2 (d − v_h T_r)/a) − T_r − v_h/a), as far as braking follows",
    rank=Rank.BODY,
    alpha="none: a speed by distance; the obstacle barrier holds beside it",
    margins=("measurement", "age", "sampling", "rounding"),
    source="terms of ISO/TS 15066 speed and separation monitoring; no certified function",
    where="kernel/src/dbk_meet.c",
    trial=_trial,
)
