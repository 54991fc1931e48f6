"""Skills of a mobile base in simulated rooms: it arrives without contact, and in an empty room δ is 0."""

from dataclasses import replace
from itertools import pairwise

import msgspec
import numpy as np
import pytest

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.core.geometry.shapes import Box, Capsule, Pose
from dualbrain.grounding.envelope.scene_rules import scene_rules
from dualbrain.records import FailureCause, ObjectLimits, SceneObject
from dualbrain.robots.interface import Command, home_state
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.simulation.scenes.scene_spec import ObjectSpec
from dualbrain.skills.mobile_base.controller import PERSON_WAIT_TIMEOUT, YIELD_SPEED, BaseController, wrap_angle
from dualbrain.skills.mobile_base.path_planning import clearance, plan_path
from dualbrain.skills.skill import HeldObject, Observation
from dualbrain.skills.time_slicing import run_to_completion
from tests.simulation.mobile_base_cell import MOBILE_BASE, MobileBaseCell, drive_to_action


@pytest.mark.parametrize(("family", "seed"), [("empty_room", 0), ("empty_room", 3), ("boxes", 1)])
def test_it_drives_to_the_shelf_and_to_the_charger_without_filter_intervention(family, seed):
    cell = MobileBaseCell(family, seed)
    outcome = cell.run(drive_to_action("shelf"), drive_to_action("charger", 0.4))
    assert outcome.kind == "succeeded", outcome.reason
    assert not np.any(cell.trace["delta"])
    assert cell.world.judgement().success
    assert cell.monitor.violations() == ()


def test_a_crossing_person_is_given_way():
    cell = MobileBaseCell("crossing", 2)
    outcome = cell.run(drive_to_action("shelf", 0.4))
    assert outcome.kind == "succeeded", outcome.reason
    assert cell.monitor.violations() == ()


@pytest.mark.parametrize(("seed", "speed"), [(11, 0.4), (47, 0.2)])
def test_the_base_clears_the_path_of_a_person_who_starts_to_walk(seed, speed):
    """The base drives on, faster than a slow contract asks for; a base that stops here is hit by the person."""
    cell = MobileBaseCell("crossing", seed)
    outcome = cell.run(drive_to_action("shelf", speed))
    assert outcome.kind == "succeeded", outcome.reason
    assert cell.monitor.violations() == ()


@pytest.mark.parametrize(("limit", "pace"), [(None, YIELD_SPEED), (0.25, 0.25), (0.9, YIELD_SPEED)])
def test_the_base_leaves_the_path_of_a_person_within_the_speed_limit_of_the_load(limit, pace):
    """A person walks toward the place of the base, which a drive at 0.1 m/s would not leave in time."""
    base = MobileBaseCell().executor.loop.controller
    scene = base.observation.scene
    walker = SceneObject(
        name="walker",
        role="person",
        shape=Capsule(0.2, 0.6),
        pose=Pose((0.0, -1.2, 0.8)),
        velocity=(0.0, 0.5, 0.0),
        stamp=scene.stamp,
    )
    cube = SceneObject(
        name="red_cube",
        role="object",
        shape=Box((0.02, 0.02, 0.02)),
        pose=Pose((0.3, 0.0, 0.6)),
        limits=ObjectLimits(speed=limit),
    )
    base.observation.scene = msgspec.structs.replace(scene, objects=(*scene.objects, walker, cube))
    base.holding = HeldObject("red_cube", 0.03)
    assert base._passing_speed([np.zeros(2), np.array([3.0, 0.0])], np.zeros(2), 0.1) == pace


def test_waiting_for_a_person_who_stays_in_the_way_ends():
    """A slow approach to the person is no progress: the skill ends at its timeout and reports why."""
    cell = MobileBaseCell("aisles", 0)
    outcome = cell.run(drive_to_action("shelf", 0.4))
    assert outcome.kind == "failed"
    assert "a person stayed in the way for 30 s" in outcome.reason
    assert PERSON_WAIT_TIMEOUT < outcome.duration < PERSON_WAIT_TIMEOUT + 10.0
    assert cell.monitor.violations() == ()


class ObservedBase:
    """A base at the origin of a room, at rest; the test lets time and pauses pass."""

    def __init__(self):
        self.state, self.scene = home_state(MOBILE_BASE), MobileBaseCell().executor.scene
        self.controller, self.now, self.paused = BaseController(MOBILE_BASE, SafetyFilter(MOBILE_BASE)), 0.0, 0.0
        self.observe()

    def observe(self, v=(0.0, 0.0)):
        state = replace(self.state, stamp=self.now, v=np.array(v))
        self.controller.observe(
            Observation(state=state, scene=self.scene, now=self.now, tool=None, paused_time=self.paused)
        )

    def pass_time(self, seconds, *, paused=0.0, v=(0.0, 0.0)):
        self.now, self.paused = self.now + seconds + paused, self.paused + paused
        self.observe(v)


def test_the_wait_for_a_person_does_not_count_a_pause():
    base = ObservedBase()
    base.controller._passing_speed = lambda path, here, speed: 0.0
    drive, results = base.controller.drive(np.array([1.0, 0.0]), 0.4, 1.0), []

    def advance():
        """Advance the routine until it rests, or record its result."""
        try:
            while next(drive) is None:
                pass
        except StopIteration as end:
            results.append(end.value)

    advance()
    for seconds, paused in ((1.0, 0.0), (1.0, 2.0 * PERSON_WAIT_TIMEOUT), (PERSON_WAIT_TIMEOUT - 3.0, 0.0)):
        base.pass_time(seconds, paused=paused)
        advance()
        assert not results
    base.pass_time(2.0)
    advance()
    assert results[0].cause is FailureCause.PERSON


def test_a_base_brakes_for_its_full_time_after_a_pause():
    base = ObservedBase()
    base.observe(v=(0.1, 0.0))
    braking = base.controller.come_to_rest("drive")
    assert next(braking).phase == "drive"
    base.pass_time(0.1, paused=10.0, v=(0.05, 0.0))
    assert next(braking).phase == "drive"
    base.pass_time(0.1)
    assert next(braking, None) is None


def test_the_free_aisle_can_be_used_and_a_person_who_leaves_is_waited_for():
    for seed, actions in (
        (0, [drive_to_action("aisle_left", 0.4), drive_to_action("shelf", 0.4)]),
        (2, [drive_to_action("shelf", 0.4)]),
    ):
        cell = MobileBaseCell("aisles", seed)
        outcome = cell.run(*actions)
        assert outcome.kind == "succeeded", outcome.reason
        assert cell.monitor.violations() == ()


@pytest.mark.parametrize("heading", [1.5, -3.0])
def test_turning_and_stopping(heading):
    cell = MobileBaseCell()
    outcome = cell.run(("turn_to", {"heading": heading, "max_turn_rate": 1.5}), ("stop", {}))
    assert outcome.kind == "succeeded", outcome.reason
    q = cell.plant.read().q
    assert abs(wrap_angle(q[2] - heading)) < 0.03
    assert np.linalg.norm(q[:2]) < 0.02
    assert not np.any(cell.trace["delta"])


def test_a_pose_without_a_name():
    cell = MobileBaseCell("boxes", 1)
    pose = {"x": 0.6, "y": 0.4, "heading": 1.0, "max_speed": 0.4, "max_turn_rate": 1.0}
    outcome = cell.run(("drive_to_pose", pose))
    assert outcome.kind == "succeeded", outcome.reason
    q = cell.plant.read().q
    assert np.linalg.norm(q[:2] - (0.6, 0.4)) < 0.1
    assert abs(wrap_angle(q[2] - 1.0)) < 0.03


def with_fence(spec):
    """The room with a fence across its full width."""
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
    return msgspec.structs.replace(spec, objects=(*spec.objects, fence))


@pytest.mark.parametrize("speed", [0.4, pytest.param(0.2, marks=pytest.mark.slow)])
def test_a_detour_that_leads_away_from_the_goal_is_progress(speed):
    """Around the end of a wall, for longer than a base may be without progress."""
    wall = ObjectSpec(
        name="wall",
        role="obstacle",
        shape=Box((0.05, 1.8, 0.3)),
        position=(0.9, -0.6, 0.3),
        mass=20.0,
        colour="oak",
        category="fence",
        fixed=True,
    )
    spec = MobileBaseCell().spec
    cell = MobileBaseCell(spec=msgspec.structs.replace(spec, objects=(*spec.objects, wall)))
    goal = {"x": 1.8, "y": -1.4, "heading": 0.0, "max_speed": speed, "max_turn_rate": 1.0}
    outcome = cell.run(("drive_to_pose", goal))
    assert outcome.kind == "succeeded", outcome.reason
    away = np.hypot(*(np.array(cell.trace["q"])[:, :2] - (1.8, -1.4)).T)
    assert cell.trace["t"][int(np.argmax(away))] - cell.trace["t"][0] > 5.0


def test_without_a_free_path_the_skill_fails_before_it_moves():
    cell = MobileBaseCell(spec=with_fence(MobileBaseCell().spec))
    outcome = cell.run(drive_to_action("shelf"))
    assert outcome.kind == "failed"
    assert "no way" in outcome.reason
    assert np.linalg.norm(cell.plant.read().q[:2]) < 0.01


STORE = Obstacle(
    name="store", shape=Box((0.5, 0.6, 0.4)), pose=Pose((1.6, 0.1, 0.4)), margin=0.05, known=True, barrier="keep_out"
)
"""A keep-out box of the site, where no object is perceived."""


def test_a_path_avoids_the_keep_out_boxes_of_the_site():
    cell = MobileBaseCell(fixed_obstacles=(STORE,))
    outcome = cell.run(drive_to_action("shelf"))
    assert outcome.kind == "succeeded", outcome.reason
    inside = np.abs(np.array(cell.trace["q"])[:, :2] - STORE.pose.position[:2]) - STORE.shape.half_extents[:2]
    assert inside.max(axis=1).min() > 0.05, "the axle keeps a distance for the footprint"
    straight = MobileBaseCell()
    straight.run(drive_to_action("shelf"))
    inside = np.abs(np.array(straight.trace["q"])[:, :2] - STORE.pose.position[:2]) - STORE.shape.half_extents[:2]
    assert inside.max(axis=1).min() < 0.0, "without the keep-out box the path leads through it"


def test_a_goal_inside_a_keep_out_box_is_refused():
    for fixed_obstacles, refused in (((), False), ((STORE,), True)):
        loop = MobileBaseCell(fixed_obstacles=fixed_obstacles).executor.loop
        pose = {"x": 1.6, "y": 0.1, "heading": 1.0, "max_speed": 0.4, "max_turn_rate": 1.0}
        contract = Contract("c-1", Context("base", ""), (Action("drive_to_pose", pose),))
        refusals = [rule(contract) for rule in scene_rules(loop.scene, loop.controller)]
        assert any(refusals) == refused


def test_the_filter_alone_keeps_the_base_from_a_wall():
    """A nominal control at full speed into the wall: the base slows down and stops without contact."""
    cell = MobileBaseCell()
    loop, nominal = cell.executor.loop, np.array([0.6, 0.0])
    for _ in range(900):
        result = loop.safety.filter(cell.plant.read(), nominal, cell.plant.now)
        cell.plant.write(Command(result.u, 0.0, 0.0))
        cell.world.advance()
        loop.scene = cell.world.perceive()
        loop.update_obstacles()
    assert cell.monitor.violations() == ()
    assert cell.plant.read().q[0] > 2.5
    assert np.abs(cell.plant.robot_velocity()).max() < 0.02


def test_a_path_keeps_the_footprint_clear_of_everything():
    cell = MobileBaseCell("boxes", 4)
    scene = cell.executor.scene
    goal = np.array(cell.spec.find_place("shelf").position[:2])
    path = run_to_completion(plan_path(scene, np.zeros(2), goal, 0.3))
    assert np.allclose(path[0], 0.0)
    assert np.allclose(path[-1], goal)
    dense = np.vstack([a + np.linspace(0, 1, 200)[:, None] * (b - a) for a, b in pairwise(path)])
    assert clearance(scene, dense).min() > 0.3
    assert run_to_completion(plan_path(scene, np.zeros(2), np.array([9.0, 0.0]), 0.3)) is None


def test_the_footprint_covers_the_housing():
    discs = (
        np.array([sphere.centre[:2] for sphere in MOBILE_BASE.spheres]),
        np.array([sphere.radius for sphere in MOBILE_BASE.spheres]),
    )
    grid = np.stack(np.meshgrid(np.linspace(-0.22, 0.22, 89), np.linspace(-0.18, 0.18, 73)), axis=-1).reshape(-1, 2)
    inside = np.linalg.norm(grid[:, None] - discs[0], axis=2) <= discs[1]
    assert inside.any(axis=1).all()
    assert np.all(np.abs(discs[0][:, 0]) > 0.1), "no disc on the axle"
