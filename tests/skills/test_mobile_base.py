"""Skills of a base in the physics of its rooms: it arrives, nothing is touched, and in an empty room δ is 0."""

from itertools import pairwise

import msgspec
import numpy as np
import pytest

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.core.geometry.shapes import Box, Pose
from dualbrain.grounding.scene_rules import scene_rules
from dualbrain.robots.interface import Command
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.simulation.scenes.scene_spec import ObjectSpec
from dualbrain.skills.mobile_base.controller import PERSON_WAIT_TIMEOUT, wrap_angle
from dualbrain.skills.mobile_base.path_planning import clearance, plan_path
from dualbrain.skills.time_slicing import run_to_completion
from tests.simulation.mobile_base_cell import MOBILE_BASE, MobileBaseCell, drive_to_action


@pytest.mark.parametrize(("family", "seed"), [("empty_room", 0), ("empty_room", 3), ("boxes", 1)])
def test_it_drives_to_the_shelf_and_to_the_charger_and_the_filter_has_nothing_to_do(family, seed):
    hall = MobileBaseCell(family, seed)
    outcome = hall.run(drive_to_action("shelf"), drive_to_action("charger", 0.4))
    assert outcome.kind == "succeeded", outcome.reason
    assert not np.any(hall.trace["delta"])
    assert hall.world.judgement().success
    assert hall.monitor.violations() == ()


def test_a_person_who_crosses_is_let_pass():
    hall = MobileBaseCell("crossing", 2)
    outcome = hall.run(drive_to_action("shelf", 0.4))
    assert outcome.kind == "succeeded", outcome.reason
    assert hall.monitor.violations() == ()


@pytest.mark.parametrize(("seed", "speed"), [(11, 0.4), (47, 0.2)])
def test_who_starts_to_walk_while_the_base_is_in_the_way_is_not_stood_in_the_way_of(seed, speed):
    """The base goes on, and makes haste where its contract is slow; one that stopped was run into."""
    hall = MobileBaseCell("crossing", seed)
    outcome = hall.run(drive_to_action("shelf", speed))
    assert outcome.kind == "succeeded", outcome.reason
    assert hall.monitor.violations() == ()


def test_somebody_who_stays_in_the_way_is_not_waited_for_for_ever():
    """Inching up to them is no progress: the skill ends when its patience does, and says why."""
    hall = MobileBaseCell("aisles", 0)
    outcome = hall.run(drive_to_action("shelf", 0.4))
    assert outcome.kind == "failed"
    assert "a person stayed in the way for 30 s" in outcome.reason
    assert PERSON_WAIT_TIMEOUT < outcome.duration < PERSON_WAIT_TIMEOUT + 10.0
    assert hall.monitor.violations() == ()


def test_the_other_aisle_is_free_and_somebody_who_leaves_is_waited_for():
    for seed, actions in (
        (0, [drive_to_action("aisle_left", 0.4), drive_to_action("shelf", 0.4)]),
        (2, [drive_to_action("shelf", 0.4)]),
    ):
        hall = MobileBaseCell("aisles", seed)
        outcome = hall.run(*actions)
        assert outcome.kind == "succeeded", outcome.reason
        assert hall.monitor.violations() == ()


@pytest.mark.parametrize("heading", [1.5, -3.0])
def test_turning_and_stopping(heading):
    hall = MobileBaseCell()
    outcome = hall.run(("turn_to", {"heading": heading, "max_turn_rate": 1.5}), ("stop", {}))
    assert outcome.kind == "succeeded", outcome.reason
    q = hall.plant.read().q
    assert abs(wrap_angle(q[2] - heading)) < 0.03
    assert np.linalg.norm(q[:2]) < 0.02
    assert not np.any(hall.trace["delta"])


def test_a_pose_without_a_name():
    hall = MobileBaseCell("boxes", 1)
    pose = {"x": 0.6, "y": 0.4, "heading": 1.0, "max_speed": 0.4, "max_turn_rate": 1.0}
    outcome = hall.run(("drive_to_pose", pose))
    assert outcome.kind == "succeeded", outcome.reason
    q = hall.plant.read().q
    assert np.linalg.norm(q[:2] - (0.6, 0.4)) < 0.1
    assert abs(wrap_angle(q[2] - 1.0)) < 0.03


def barred(spec):
    """The room with a fence across it."""
    fence = ObjectSpec(
        name="fence",
        role="obstacle",
        shape=Box((0.05, 2.39, 0.3)),
        position=(3.0, 0.0, 0.3),
        mass=20.0,
        colour="oak",
        category="fence",
        fixed=True,
    )
    return msgspec.structs.replace(spec, things=(*spec.things, fence))


def test_where_no_way_leads_the_skill_says_so_and_stays():
    hall = MobileBaseCell(spec=barred(MobileBaseCell().spec))
    outcome = hall.run(drive_to_action("shelf"))
    assert outcome.kind == "failed"
    assert "no way" in outcome.reason
    assert np.linalg.norm(hall.plant.read().q[:2]) < 0.01


STORE = Obstacle(
    name="store", shape=Box((0.5, 0.6, 0.4)), pose=Pose((1.6, 0.1, 0.4)), margin=0.05, known=True, barrier="keep_out"
)
"""A box that a site closes, where nothing is to be seen."""


def test_a_way_leads_round_what_the_site_closes():
    hall = MobileBaseCell(fixed_obstacles=(STORE,))
    outcome = hall.run(drive_to_action("shelf"))
    assert outcome.kind == "succeeded", outcome.reason
    inside = np.abs(np.array(hall.trace["q"])[:, :2] - STORE.pose.position[:2]) - STORE.shape.half_extents[:2]
    assert inside.max(axis=1).min() > 0.05, "the axle, and some of the footprint around it"
    straight = MobileBaseCell()
    straight.run(drive_to_action("shelf"))
    inside = np.abs(np.array(straight.trace["q"])[:, :2] - STORE.pose.position[:2]) - STORE.shape.half_extents[:2]
    assert inside.max(axis=1).min() < 0.0, "without the site's word the way leads through it"


def test_nobody_is_sent_where_the_site_closes_the_floor():
    for standing, refused in (((), False), ((STORE,), True)):
        layer = MobileBaseCell(standing=standing).executor
        pose = {"x": 1.6, "y": 0.1, "heading": 1.0, "max_speed": 0.4, "max_turn_rate": 1.0}
        contract = Contract("c-1", Context("base", ""), (Action("drive_to_pose", pose),))
        said = [rule(contract) for rule in scene_rules(layer.scene, layer.controller)]
        assert any(said) == refused


def test_without_skills_the_filter_alone_keeps_the_base_from_a_wall():
    """A nominal control at full speed into the wall: it slows, stops, and nothing is touched."""
    hall = MobileBaseCell()
    layer, wish = hall.executor, np.array([0.6, 0.0])
    for _ in range(900):
        answer = layer.safety.filter(hall.plant.read(), wish, hall.plant.now)
        hall.plant.write(Command(answer.u, 0.0, 0.0))
        hall.world.advance()
        layer.scene = hall.world.perceive()
        layer._update_obstacles()
    assert hall.monitor.violations() == ()
    assert hall.plant.read().q[0] > 2.5
    assert np.abs(hall.plant.robot_velocity()).max() < 0.02


def test_a_path_keeps_the_footprint_clear_of_everything():
    hall = MobileBaseCell("boxes", 4)
    scene = hall.executor.scene
    goal = np.array(hall.spec.find_place("shelf").position[:2])
    path = run_to_completion(plan_path(scene, np.zeros(2), goal, 0.3))
    assert np.allclose(path[0], 0.0)
    assert np.allclose(path[-1], goal)
    dense = np.vstack([a + np.linspace(0, 1, 200)[:, None] * (b - a) for a, b in pairwise(path)])
    assert clearance(scene, dense).min() > 0.3
    assert run_to_completion(plan_path(scene, np.zeros(2), np.array([9.0, 0.0]), 0.3)) is None


def test_the_footprint_covers_the_housing():
    discs = (
        np.array([ball.centre[:2] for ball in MOBILE_BASE.spheres]),
        np.array([ball.radius for ball in MOBILE_BASE.spheres]),
    )
    grid = np.stack(np.meshgrid(np.linspace(-0.22, 0.22, 89), np.linspace(-0.18, 0.18, 73)), axis=-1).reshape(-1, 2)
    inside = np.linalg.norm(grid[:, None] - discs[0], axis=2) <= discs[1]
    assert inside.any(axis=1).all()
    assert np.all(np.abs(discs[0][:, 0]) > 0.1), "no disc on the axle"
