"""The same skills on two arm models: on the bare scene every contract succeeds and the filter changes nothing."""

import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Capsule, Pose
from dualbrain.records import FailureCause, SceneObject
from dualbrain.simulation.perception.noisy_perception import NO_NOISE, PerceptionNoise
from tests.skills.arm.test_skills_in_simulation import SkillCell, grasp, move_to, place

HOME = ("home", {"speed": 0.4})
CONTRACTS = [
    (0, NO_NOISE, (grasp(speed=0.4), place(speed=0.4, route="near_base"))),
    (3, PerceptionNoise(), (grasp(finger_axis="across", opening=0.08), place(speed=0.4))),
    pytest.param(
        4,
        NO_NOISE,
        (grasp(approach="tilted", speed=0.35), ("hold", {"duration": 0.5}), place(route="left", speed=0.3)),
        marks=pytest.mark.slow,
    ),
    (5, PerceptionNoise(), (grasp(approach="side", speed=0.3), HOME, place(clearance=0.2, speed=0.3), HOME)),
    pytest.param(
        1,
        PerceptionNoise(),
        (move_to("table_left", speed=0.4), move_to("blue_bowl", speed=0.4, route="right"), HOME),
        marks=pytest.mark.slow,
    ),
]


def push(**changes):
    base = {"object": "red_cube", "destination": "table_front", "distance": 0.1, "speed": 0.3, "clearance": 0.1}
    return ("push", {**base, "wait": "none", **changes})


@pytest.mark.parametrize(("seed", "noise", "actions"), CONTRACTS)
def test_contracts_on_the_ur5e_succeed_with_delta_zero_on_every_tick(seed, noise, actions):
    cell = SkillCell(seed=seed, noise=noise, robot="ur5e")
    outcome = cell.run(*actions)
    assert outcome.kind == "succeeded", outcome.reason
    assert cell.filter_never_intervened()
    assert cell.monitor.violations() == ()


@pytest.mark.parametrize(
    ("robot", "seed", "destination", "distance"),
    [
        ("panda", 1, "blue_bowl", 0.15),
        ("ur5e", 2, "table_left", 0.05),
        pytest.param("ur5e", 1, "blue_bowl", 0.15, marks=pytest.mark.slow),
        pytest.param("panda", 2, "table_left", 0.05, marks=pytest.mark.slow),
    ],
)
def test_a_push_moves_the_object_towards_its_destination(robot, seed, destination, distance):
    cell = SkillCell(seed=seed, noise=PerceptionNoise(), robot=robot)
    before = np.array(cell.plant.true_pose("red_cube").position)
    spec = cell.spec
    goal = next((p.position for p in spec.places if p.name == destination), None) or spec.find(destination).position
    outcome = cell.run(push(destination=destination, distance=distance))
    assert outcome.kind == "succeeded", outcome.reason
    moved = np.array(cell.plant.true_pose("red_cube").position) - before
    direction = (np.array(goal) - before)[:2]
    direction /= np.linalg.norm(direction)
    assert moved[:2] @ direction == pytest.approx(distance, abs=0.02)
    assert abs(moved[:2] @ np.array([-direction[1], direction[0]])) < 0.02
    assert abs(moved[2]) < 0.003
    assert cell.filter_never_intervened()
    assert cell.monitor.violations() == ()


def test_a_push_past_its_destination_fails():
    cell = SkillCell(robot="panda")
    outcome = cell.run(push(destination="table_front", distance=0.25), push(destination="table_front", distance=0.25))
    assert outcome.kind == "failed"
    assert "nearer to red_cube than the push is long" in outcome.reason


def test_a_push_that_gave_way_to_a_person_does_not_come_down_on_the_object():
    """A forearm crosses above the cube while it is pushed; the arm rises over it, and the push ends."""
    cell = SkillCell(seed=1)
    perceive, loop = cell.world.perceive, cell.executor.loop
    first = perceive().find("red_cube").pose.position
    heights, crossing = [], []

    def perceive_with_person():
        scene = perceive()
        moved = np.hypot(*np.subtract(scene.find("red_cube").pose.position, first)[:2])
        tool = loop.safety.tool(loop.state.q).position
        if loop.phase == "push" and moved > 0.03 and not crossing:
            crossing.append((scene.stamp, tool))
        if not crossing:
            return scene
        since, (x, y, _) = scene.stamp - crossing[0][0], crossing[0][1]
        heights.append((loop.phase, float(tool[2])))
        forearm = SceneObject(
            name="forearm",
            role="person",
            shape=Capsule(0.045, 0.15),
            pose=Pose((float(x), float(y) + 0.9 - 0.6 * since, 0.22), (0.5**0.5, 0.0, 0.5**0.5, 0.0)),
            velocity=(0.0, -0.6, 0.0),
            stamp=scene.stamp,
            error=0.01,
        )
        return msgspec.structs.replace(scene, objects=(*scene.objects, forearm)) if since < 5.0 else scene

    cell.world.perceive = perceive_with_person
    outcome = cell.run(push(destination="table_left", distance=0.12))
    assert outcome.kind == "failed"
    assert outcome.actions[-1].cause is FailureCause.PERSON
    risen = next(k for k, (_, height) in enumerate(heights) if height > 0.2)
    assert min(height for _, height in heights[risen:]) > 0.15


def test_a_push_with_something_in_the_hand_fails():
    cell = SkillCell(robot="panda")
    outcome = cell.run(grasp(speed=0.4), push())
    assert [action.status for action in outcome.actions] == ["done", "failed"]
    assert "already holding" in outcome.reason
