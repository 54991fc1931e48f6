"""separation: the speed toward a person falls with the distance, so that the robot stops before contact."""

from __future__ import annotations

from math import sqrt

import numpy as np

from dualbrain.core.geometry.shapes import Capsule, Pose
from dualbrain.safety.barriers.barrier import Array, BarrierSpec, Scenario
from dualbrain.safety.barriers.scenarios import home_posture, moving_spheres, sparse_panda_filter, tool_push
from dualbrain.safety.cbf.obstacles import Obstacle, SpeedAndSeparation
from dualbrain.safety.cbf.rows import Rank

PERSON_POSITION = (0.85, 0.0, 0.45)
RADIUS, HALF_LENGTH = 0.08, 0.3


def max_approach_speed(distance: float, person_speed: float, reaction: float, deceleration: float) -> float:
    """The speed v [m/s] with d = v_h (T_r + T_s) + v T_r + v²/(2a), T_s = v/a; 0 if d < v_h T_r.

    `distance` d [m], `person_speed` v_h [m/s], `reaction` T_r [s] and `deceleration` a [m/s²] of the robot.
    """
    spare = distance - person_speed * reaction
    late = reaction + person_speed / deceleration
    return deceleration * (sqrt(late * late + 2.0 * spare / deceleration) - late) if spare > 0.0 else 0.0


def _scenario() -> Scenario:
    safety = sparse_panda_filter()
    separation = SpeedAndSeparation(reaction=0.1, brake=1.0, approach=0.2)
    person = Obstacle(
        name="person",
        shape=Capsule(RADIUS, HALF_LENGTH),
        pose=Pose(PERSON_POSITION),
        rank=Rank.BODY,
        separation=separation,
        barrier="separation",
    )
    safety.observe([person])

    def gap(q: Array) -> Array:
        centres, radii = moving_spheres(safety, q)
        axis = np.column_stack([np.full(len(centres), PERSON_POSITION[0]), np.zeros(len(centres)), centres[:, 2]])
        axis[:, 2] = np.clip(centres[:, 2], PERSON_POSITION[2] - HALF_LENGTH, PERSON_POSITION[2] + HALF_LENGTH)
        return np.linalg.norm(centres - axis, axis=1) - radii - RADIUS

    def h(q: Array, u: Array) -> float:
        """Allowed minus actual approach speed, least over spheres; 2e-3 m/s compensates the margins of the rows."""
        dt = 1e-3
        near, far = gap(q), gap(q + dt * u)
        toward = (near - far) / dt
        allowed = [max_approach_speed(d, separation.approach, separation.reaction, separation.brake) for d in near]
        return float(np.min(np.array(allowed) - toward) + 2e-3)

    return Scenario(safety=safety, start=home_posture(safety), nominal=tool_push(safety, (1.0, 0.0, 0.0)), h=h)


BARRIER = BarrierSpec(
    name="separation",
    description="the speed toward a person lets the robot stop before contact, even if the person keeps approaching",
    h="h = v_max(d) − speed toward the person",
    row="n'J u ≥ −v_max(d), v_max = a (√((T_r + v_h/a)² + 2 (d − v_h T_r)/a) − T_r − v_h/a), if braking can follow",
    rank=Rank.BODY,
    alpha="none: the speed depends on the distance; the obstacle barrier applies as well",
    margins=("measurement", "age", "sampling", "rounding"),
    source="formula of speed and separation monitoring in ISO/TS 15066; not a certified function",
    implementation="kernel/src/rows/dbk_obstacle_rows.c",
    scenario=_scenario,
)
