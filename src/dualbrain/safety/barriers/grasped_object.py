"""held_object: keeps a grasped object away from obstacles and from the robot, like a link of the robot."""

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
    description="a grasped object, inflated by its pose error in the hand, keeps away from obstacles and the arm",
    h="as for obstacle and self_collision, for the spheres of the grasped object, with its pose error in the margin",
    row="as for obstacle and self_collision",
    rank=Rank.OBSTACLE,
    alpha="as for obstacle and self_collision",
    margins=("sampling", "tracking", "measurement", "age", "rounding"),
    source="design: the object is attached at the pose measured at the grasp",
    implementation="safety/cbf/grasped_object.py onto kernel/src/rows/dbk_obstacle_rows.c",
    scenario=_scenario,
)
