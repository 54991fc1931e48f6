"""workspace: the hand and the grasped object stay between heights and inside planes."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

import numpy as np

from dualbrain.core.geometry.shapes import HalfSpace, Pose, Quaternion, Vector
from dualbrain.errors import ConfigurationError
from dualbrain.safety.barriers.barrier import Array, BarrierSpec, Scenario
from dualbrain.safety.barriers.scenarios import home_posture, moving_spheres, sparse_panda_filter, tool_push
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.cbf.rows import Rank

HAND_PARTS = ("hand", "fingers", "held")


def plane(
    name: str, point: Vector, inward: Vector, *, parts: Sequence[str] = HAND_PARTS, margin: float = 0.0
) -> Obstacle:
    """Obstacle that keeps `parts` `margin` [m] inside the plane through `point` [m]; `inward` points to the inside."""
    return Obstacle(
        name=name,
        shape=HalfSpace(),
        pose=Pose(point, rotation_to_normal(inward)),
        margin=margin,
        rank=Rank.WORKSPACE,
        parts=tuple(parts),
        known=True,
        barrier="workspace",
    )


def height_limits(lowest: float, highest: float, *, parts: Sequence[str] = HAND_PARTS) -> tuple[Obstacle, Obstacle]:
    """Obstacles that keep `parts` between two heights [m] above the base."""
    return (
        plane("lowest height", (0.0, 0.0, lowest), (0.0, 0.0, 1.0), parts=parts),
        plane("greatest height", (0.0, 0.0, highest), (0.0, 0.0, -1.0), parts=parts),
    )


def rotation_to_normal(normal: Vector) -> Quaternion:
    """The smallest rotation, as a quaternion (w, x, y, z), that maps the z-axis to `normal`."""
    size = sqrt(sum(e * e for e in normal))
    if not size > 1e-9:
        raise ConfigurationError("normal of a plane", got=normal, allowed="a vector that is not zero")
    x, y, z = (e / size for e in normal)
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
    row="n'J_s u ≥ −α h + …, as for obstacles, for the spheres of Obstacle.parts only",
    rank=Rank.WORKSPACE,
    alpha="FilterConfig.alpha",
    margins=("sampling", "tracking", "rounding"),
    source="paper 4.2: end-effector height and workspace limits",
    implementation="safety/barriers/workspace.py onto kernel/src/rows/dbk_obstacle_rows.c",
    scenario=_scenario,
)
