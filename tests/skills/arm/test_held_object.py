"""How far what is held hangs below the tool: eyes err, but what stands, stands on the support."""

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
    ("height", "error", "foot"),
    [(0.108, 0.009, 0.1), (0.092, 0.009, 0.1), (0.108, 0.001, 0.108), (0.15, 0.009, 0.15), (0.05, 0.009, 0.05)],
)
def test_what_eyes_cannot_tell_from_standing_stands(height, error, foot):
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
    assert arm.below_tool == pytest.approx(tool.position[2] - foot, abs=1e-12)


@pytest.mark.parametrize("seed", [0, 1, 3])
def test_the_foot_of_what_is_held_is_where_truth_has_it(seed):
    """Eyes alone would be wrong by up to 9 mm."""
    bench = SkillCell(seed=seed, noise=PerceptionNoise())
    assert bench.run(grasp(speed=0.4), ("hold", {"duration": 0.3})).kind == "succeeded"
    limb = bench.layer.controller
    believed = limb.observation.tool.position[2] - limb.below_tool
    assert believed == pytest.approx(bench.plant.true_pose("red_cube").position[2] - 0.025, abs=0.002)
