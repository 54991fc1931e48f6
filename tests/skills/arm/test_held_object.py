"""Extent of the held object below the tool; within the perception error, an object is assumed to be on the support."""

import pytest

from dualbrain.core.geometry.shapes import Box, HalfSpace, Pose
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.simulation.perception.noisy_perception import PerceptionNoise
from dualbrain.skills.arm.controller import ArmController
from dualbrain.skills.skill import Observation
from tests.skills.arm.test_skills_in_simulation import SkillCell, grasp

BODY = load_robot("panda")
TABLE = SceneObject(name="table", role="support", shape=HalfSpace(), pose=Pose((0.0, 0.0, 0.1)))


@pytest.mark.parametrize(
    ("height", "error", "bottom"),
    [(0.108, 0.009, 0.1), (0.092, 0.009, 0.1), (0.108, 0.001, 0.108), (0.15, 0.009, 0.15), (0.05, 0.009, 0.05)],
)
def test_within_the_perception_error_the_object_is_assumed_to_be_on_the_support(height, error, bottom):
    cube = SceneObject(
        name="cube", role="object", shape=Box((0.02, 0.02, 0.025)), pose=Pose((0.5, -0.2, height + 0.025)), error=error
    )
    safety, state = SafetyFilter(BODY), home_state(BODY)
    tool = safety.tool(state.q)
    arm = ArmController(BODY, safety)
    arm.observe(
        Observation(
            state=state, scene=Scene(robot="panda", stamp=0.0, version=1, objects=(TABLE, cube)), now=0.0, tool=tool
        )
    )
    arm.record_grasp(cube)
    assert arm.below_tool == pytest.approx(tool.position[2] - bottom, abs=1e-12)


@pytest.mark.parametrize("seed", [0, 1, 3])
def test_the_bottom_of_the_held_object_matches_the_true_pose(seed):
    """Perception alone would be wrong by up to 9 mm."""
    cell = SkillCell(seed=seed, noise=PerceptionNoise())
    assert cell.run(grasp(speed=0.4), ("hold", {"duration": 0.3})).kind == "succeeded"
    controller = cell.executor.loop.controller
    estimate = controller.observation.tool.position[2] - controller.below_tool
    assert estimate == pytest.approx(cell.plant.true_pose("red_cube").position[2] - 0.025, abs=0.002)
