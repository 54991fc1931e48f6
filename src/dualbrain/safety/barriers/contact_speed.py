"""contact: bounds the approach speed of a pair that a skill has permitted to touch."""

from __future__ import annotations

import numpy as np

from dualbrain.core.geometry.shapes import Box, Pose
from dualbrain.safety.barriers.barrier import Array, BarrierSpec, Scenario
from dualbrain.safety.barriers.scenarios import home_posture, sparse_panda_filter, tool_push
from dualbrain.safety.cbf.obstacles import Contact, Obstacle
from dualbrain.safety.cbf.rows import Rank

SPEED = 0.03


def _scenario() -> Scenario:
    safety = sparse_panda_filter()
    start = home_posture(safety)
    x, y, z = safety.tool(start).position.tolist()
    top = z - 0.06
    safety.observe([Obstacle(name="block", shape=Box((0.1, 0.1, 0.1)), pose=Pose((x, y, top - 0.1)))])
    safety.permit([Contact("fingers", "block", SPEED), Contact("hand", "block", SPEED)])
    fingers = [i for i, group in enumerate(safety.spheres(start, 0.0)[2]) if group == "fingers"]

    def h(q: Array, u: Array) -> float:
        """Permitted speed max(SPEED, α·distance) minus the downward speed of the fingers, least over spheres."""
        dt = 1e-3
        here, radii, _ = safety.spheres(q, 0.0)
        there, _, _ = safety.spheres(q + dt * u, 0.0)
        down = (here[fingers, 2] - there[fingers, 2]) / dt
        gap = here[fingers, 2] - radii[fingers] - top
        allowed = np.maximum(SPEED, safety.robot_model.alpha * np.maximum(gap, 0.0))
        return float(np.min(allowed - down) + 1e-3)

    return Scenario(safety=safety, start=start, nominal=tool_push(safety, (0.0, 0.0, -1.0)), h=h, duration=0.6)


BARRIER = BarrierSpec(
    name="contact",
    description="a permitted pair may touch, but its approach speed stays at or below the speed of the permit",
    h="h = permitted approach speed − actual approach speed",
    row="n'(J u − v_o) ≥ −max(speed, s(h))",
    rank=Rank.OBSTACLE,
    alpha="as for obstacle",
    margins=("sampling", "rounding"),
    source="design: the skill declares contact permits for each phase; a contract cannot",
    implementation="safety/cbf/obstacles.py onto kernel/src/rows/dbk_obstacle_rows.c",
    scenario=_scenario,
)
