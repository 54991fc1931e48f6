"""The same skills on arms of two makes: on the bare scene every contract succeeds, and the filter has nothing to do."""

import numpy as np
import pytest

from dualbrain.simulation.perception.noisy_perception import NO_NOISE, PerceptionNoise
from tests.skills.arm.test_skills_in_simulation import SkillCell, grasp, move_to, place

HOME = ("home", {"speed": 0.4})
ERRANDS = [
    (0, NO_NOISE, (grasp(speed=0.4), place(speed=0.4, route="near_base"))),
    (3, PerceptionNoise(), (grasp(finger_axis="across", opening=0.08), place(speed=0.4))),
    (4, NO_NOISE, (grasp(approach="tilted", speed=0.35), ("hold", {"duration": 0.5}), place(route="left", speed=0.3))),
    (5, PerceptionNoise(), (grasp(approach="side", speed=0.3), HOME, place(clearance=0.2, speed=0.3), HOME)),
    (1, PerceptionNoise(), (move_to("table_left", speed=0.4), move_to("blue_bowl", speed=0.4, route="right"), HOME)),
]


def push(**changes):
    base = {"object": "red_cube", "destination": "table_front", "distance": 0.1, "speed": 0.3, "clearance": 0.1}
    return ("push", {**base, "wait": "none", **changes})


@pytest.mark.parametrize(("seed", "noise", "actions"), ERRANDS)
def test_contracts_on_the_ur5e_succeed_with_delta_zero_on_every_tick(seed, noise, actions):
    bench = SkillCell(seed=seed, noise=noise, robot="ur5e")
    outcome = bench.run(*actions)
    assert outcome.kind == "succeeded", outcome.reason
    assert bench.untouched()
    assert bench.monitor.violations() == ()


@pytest.mark.parametrize("robot", ["panda", "ur5e"])
@pytest.mark.parametrize(("seed", "destination", "distance"), [(1, "blue_bowl", 0.15), (2, "table_left", 0.05)])
def test_a_push_moves_the_thing_where_it_was_told(robot, seed, destination, distance):
    bench = SkillCell(seed=seed, noise=PerceptionNoise(), robot=robot)
    before = np.array(bench.plant.true_pose("red_cube").position)
    spec = bench.spec
    goal = next((p.position for p in spec.places if p.name == destination), None) or spec.find(destination).position
    outcome = bench.run(push(destination=destination, distance=distance))
    assert outcome.kind == "succeeded", outcome.reason
    moved = np.array(bench.plant.true_pose("red_cube").position) - before
    way = (np.array(goal) - before)[:2]
    way /= np.linalg.norm(way)
    assert moved[:2] @ way == pytest.approx(distance, abs=0.02)
    assert abs(moved[:2] @ np.array([-way[1], way[0]])) < 0.02
    assert abs(moved[2]) < 0.003
    assert bench.untouched()
    assert bench.monitor.violations() == ()


def test_a_push_past_its_destination_is_refused_before_anything_moves():
    bench = SkillCell(robot="panda")
    outcome = bench.run(push(destination="table_front", distance=0.25), push(destination="table_front", distance=0.25))
    assert outcome.kind == "failed"
    assert "nearer to red_cube than the push is long" in outcome.reason


def test_a_push_with_something_in_the_hand_fails():
    bench = SkillCell(robot="panda")
    outcome = bench.run(grasp(speed=0.4), push())
    assert [action.status for action in outcome.actions] == ["done", "failed"]
    assert "already holding" in outcome.reason
