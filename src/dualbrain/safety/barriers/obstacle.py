"""obstacle: every link of the robot keeps away from every perceived obstacle, static or moving."""

from __future__ import annotations

import numpy as np

from dualbrain.core.geometry.shapes import Pose, Sphere
from dualbrain.safety.barriers.barrier import Array, BarrierSpec, Scenario
from dualbrain.safety.barriers.scenarios import home_posture, moving_spheres, sparse_panda_filter, tool_push
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.cbf.rows import Rank

OBSTACLE_POSITION = (0.62, 0.0, 0.45)


def _scenario() -> Scenario:
    safety = sparse_panda_filter()
    safety.observe([Obstacle(name="ball", shape=Sphere(0.05), pose=Pose(OBSTACLE_POSITION))])
    start = home_posture(safety)
    direction = np.array(OBSTACLE_POSITION) - safety.tool(start).position

    def h(q: Array, u: Array) -> float:
        del u
        centres, radii = moving_spheres(safety, q)
        return float(np.min(np.linalg.norm(centres - np.array(OBSTACLE_POSITION), axis=1) - radii - 0.05))

    return Scenario(
        safety=safety, start=start, nominal=tool_push(safety, (direction / np.linalg.norm(direction)).tolist()), h=h
    )


BARRIER = BarrierSpec(
    name="obstacle",
    description="every sphere of the robot stays outside every perceived sphere, capsule, box and half-space",
    h="h = d(c_s, obstacle) − r_s − margins",
    row="n'J_s u ≥ −s(h) + n'v_o + e_v + tracking Σ|n'J_k| + Δt/2 C",
    rank=Rank.OBSTACLE,
    alpha="FilterConfig.alpha, or Obstacle.alpha; people have rank BODY",
    margins=("sampling", "tracking", "measurement", "age", "rounding"),
    source="paper 4.2; moving obstacles: ∂h/∂t = −n'v_o",
    implementation="kernel/src/rows/dbk_obstacle_rows.c",
    scenario=_scenario,
)
