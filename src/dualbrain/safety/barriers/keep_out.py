"""keep_out: the footprint of a mobile base stays out of regions of the floor."""

from __future__ import annotations

from math import cos, sin

import numpy as np

from dualbrain.core.geometry.shapes import Box, Pose
from dualbrain.core.geometry.validation import check_length, check_number, check_vector
from dualbrain.robots.differential_drive import make_differential_base
from dualbrain.robots.model import Bound, RobotModel, TrackingErrorModel
from dualbrain.safety.barriers.barrier import Array, BarrierSpec, Scenario
from dualbrain.safety.barriers.scenarios import EXACT_TRACKING
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.cbf.rows import Rank

HALF_HEIGHT = 5.0
"""Half the height of a region [m]: so large that the nearest exit is always horizontal."""
MAX_YAW = 1e3
"""Largest yaw [rad]."""
REGION = (1.2, 0.05, 0.3, 0.4)


def keep_out_region(name: str, x: float, y: float, half_x: float, half_y: float, yaw: float = 0.0) -> Obstacle:
    """Obstacle for a floor rectangle that the footprint must not enter: centre, half sides [m] and yaw [rad].

    Raises `GeometryError` for numbers that are not usable.
    """
    x, y, _ = check_vector(f"centre of keep-out region {name!r}", (x, y, 0.0))
    half_x, half_y = (check_length(f"half side of keep-out region {name!r}", half) for half in (half_x, half_y))
    yaw = check_number(f"yaw of keep-out region {name!r}", yaw, -MAX_YAW, MAX_YAW)
    rotation = (cos(0.5 * yaw), 0.0, 0.0, sin(0.5 * yaw))
    return Obstacle(
        name=name,
        shape=Box((half_x, half_y, HALF_HEIGHT)),
        pose=Pose((x, y, 0.0), rotation),
        rank=Rank.WORKSPACE,
        known=True,
        barrier="keep_out",
    )


def scenario_base() -> RobotModel:
    """A small differential-drive base with four footprint discs, two ahead of the axle and two behind it."""
    provenance = "example value for scenarios"
    discs = [(x, y, 0.13) for x in (-0.12, 0.12) for y in (-0.1, 0.1)]
    return make_differential_base(
        "trolley",
        discs,
        speed=Bound(0.8, "m/s", provenance),
        turn_rate=Bound(2.0, "rad/s", provenance),
        acceleration=Bound(1.6, "m/s^2", provenance),
        turn_acceleration=Bound(6.0, "rad/s^2", provenance),
        tracking=TrackingErrorModel(lag=0.0, position_error=0.0, rate=0.0, provenance=provenance),
    )


def _scenario() -> Scenario:
    safety = SafetyFilter(scenario_base(), EXACT_TRACKING)
    x, y, half_x, half_y = REGION
    safety.observe([keep_out_region("stairs", *REGION)])

    def h(q: Array, u: Array) -> float:
        del u
        centres, radii, _ = safety.spheres(q, 0.0)
        out = np.maximum(np.abs(centres[:, :2] - (x, y)) - (half_x, half_y), 0.0)
        return float(np.min(np.linalg.norm(out, axis=1) - radii))

    return Scenario(
        safety=safety, start=np.array([0.0, 0.0, 0.1]), nominal=lambda q: np.array([0.8, 0.0]), h=h, duration=6.0
    )


BARRIER = BarrierSpec(
    name="keep_out",
    description="no disc of the footprint of a base enters the region; discs off the axle let the base steer away",
    h="h = d(p_i, rectangle) − r_i, p_i' = [e_θ, l_i e_θ⊥] (v, ω)",
    row="n'J_i u ≥ −s(h) + …, as for obstacles",
    rank=Rank.WORKSPACE,
    alpha="FilterConfig.alpha",
    margins=("sampling", "tracking", "measurement", "rounding"),
    source="paper 4.2: keep-out regions; footprint discs: design 4",
    implementation="safety/barriers/keep_out.py onto kernel/src/rows/dbk_obstacle_rows.c",
    scenario=_scenario,
)
