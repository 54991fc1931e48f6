"""workspace: the hand and the grasped object stay between heights and inside planes."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

import numpy as np

from dualbrain.core.geometry.shapes import HalfSpace, Pose, Quaternion, Vector
from dualbrain.core.geometry.validation import MAX_COORDINATE, check_direction, check_length, check_number, check_vector
from dualbrain.safety.barriers.barrier import Array, BarrierSpec, Scenario
from dualbrain.safety.barriers.scenarios import home_posture, moving_spheres, sparse_panda_filter, tool_push
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.cbf.rows import Rank

HAND_PARTS = ("hand", "fingers", "held")


def plane(
    name: str, point: Vector, inward: Vector, *, parts: Sequence[str] = HAND_PARTS, margin: float = 0.0
) -> Obstacle:
    """Obstacle that keeps `parts` `margin` [m] inside the plane through `point` [m]; `inward` points to the inside.

    Raises `GeometryError` for numbers that are not usable and for a normal of length 0.
    """
    return Obstacle(
        name=name,
        shape=HalfSpace(),
        pose=Pose(check_vector(f"point of plane {name!r}", point), rotation_to_normal(inward)),
        margin=check_length(f"margin of plane {name!r}", margin),
        rank=Rank.WORKSPACE,
        parts=tuple(parts),
        known=True,
        barrier="workspace",
    )


def height_limits(lowest: float, highest: float, *, parts: Sequence[str] = HAND_PARTS) -> tuple[Obstacle, Obstacle]:
    """Obstacles that keep `parts` between two heights [m] above the base.

    Raises `GeometryError` if a height is not usable, or the greatest is not above the lowest.
    """
    lowest = check_number("lowest height", lowest, -MAX_COORDINATE, MAX_COORDINATE)
    highest = check_number("greatest height", highest, lowest, MAX_COORDINATE)
    return (
        plane("lowest height", (0.0, 0.0, lowest), (0.0, 0.0, 1.0), parts=parts),
        plane("greatest height", (0.0, 0.0, highest), (0.0, 0.0, -1.0), parts=parts),
    )


def rotation_to_normal(normal: Vector) -> Quaternion:
    """The smallest rotation, as a quaternion (w, x, y, z), that maps the z-axis to `normal`."""
    x, y, z = check_direction("normal of a plane", normal)
    if z < -1.0 + 1e-9:
        return (0.0, 1.0, 0.0, 0.0)
    w = sqrt(0.5 * (1.0 + z))
    return (w, -y / (2.0 * w), x / (2.0 * w), 0.0)


def _scenario() -> Scenario:
    safety = sparse_panda_filter()
    start = home_posture(safety)
    lowest = float(safety.tool(start).position[2]) - 0.12
    safety.observe(height_limits(lowest, 1.2))
    arm = sum(
        link.group == "arm"
        for link in safety.robot_model.links
        for s in safety.robot_model.spheres
        if s.link == link.name
    )
    arm -= sum(sphere.link == "link0" for sphere in safety.robot_model.spheres)

    def h(q: Array, u: Array) -> float:
        del u
        centres, radii = moving_spheres(safety, q)
        return float(np.min(centres[arm:, 2] - radii[arm:]) - lowest)

    return Scenario(safety=safety, start=start, nominal=tool_push(safety, (0.0, 0.0, -1.0)), h=h)


BARRIER = BarrierSpec(
    name="workspace",
    description="the hand, the fingers and the grasped object stay between two heights and within planes",
    h="h = n'(c_s − p) − r_s − margin",
    row="n'J_s u ≥ −s(h) + …, as for obstacles, for the spheres of Obstacle.parts only",
    rank=Rank.WORKSPACE,
    alpha="FilterConfig.alpha",
    margins=("sampling", "tracking", "rounding"),
    source="paper 4.2: end-effector height and workspace limits",
    implementation="safety/barriers/workspace.py onto kernel/src/rows/dbk_obstacle_rows.c",
    scenario=_scenario,
)
