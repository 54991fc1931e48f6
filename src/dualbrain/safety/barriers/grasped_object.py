"""held_object: what the hand carries is kept from things and from the robot like a part of the body."""

from __future__ import annotations

import numpy as np

from dualbrain.core.geometry.shapes import HalfSpace, Pose
from dualbrain.safety.barriers.barrier import Array, BarrierSpec, Scenario
from dualbrain.safety.barriers.scenarios import home_posture, sparse_panda_filter, tool_push
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.cbf.rows import Rank

LENGTH, RADIUS, ERROR = 0.12, 0.03, 0.005


def _scenario() -> Scenario:
    safety = sparse_panda_filter()
    start = home_posture(safety)
    table = float(safety.tool(start).position[2]) - 0.28
    safety.observe([Obstacle(name="table", shape=HalfSpace(), pose=Pose((0.0, 0.0, table)))])
    safety.attach(np.array([[0.0, 0.0, LENGTH, RADIUS]]), ERROR)

    def h(q: Array, u: Array) -> float:
        del u
        tool = safety.tool(q)
        lowest = tool.position + LENGTH * tool.rotation[:, 2]
        return float(lowest[2] - RADIUS - ERROR - table)

    return Scenario(safety=safety, start=start, nominal=tool_push(safety, (0.0, 0.0, -1.0)), h=h)


BARRIER = BarrierSpec(
    name="held_object",
    description="a held thing is kept from obstacles and from the arm; the error of its pose in the hand inflates it",
    h="as obstacle and self_collision, with the held spheres and held_error in the margin",
    row="as obstacle and self_collision",
    rank=Rank.OBSTACLE,
    alpha="as obstacle and self_collision",
    margins=("sampling", "tracking", "measurement", "age", "rounding"),
    source="design: attached at the pose measured at the grasp",
    implementation="safety/cbf/grasped_object.py onto kernel/src/rows/dbk_obstacle_rows.c",
    scenario=_scenario,
)
