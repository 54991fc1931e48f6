"""A simulated mobile manipulator: the skills of base and arm, with the filter over the whole robot."""

import sys

import msgspec
import numpy as np
import pytest

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.control.contract_executor import ContractExecutor
from dualbrain.control.control_loop import ControlLoop, ControlLoopConfig, LoopObserver
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Trace
from dualbrain.core.geometry.shapes import IDENTITY_QUATERNION, Box, Pose
from dualbrain.grounding.envelope.scene_rules import scene_rules
from dualbrain.grounding.offline_gate import controller_at_home, scene_from_spec
from dualbrain.robots.differential_drive import control_displacement
from dualbrain.robots.interface import Command
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.simulation.perception.noisy_perception import NoisyPerception, PerceptionNoise
from dualbrain.simulation.plant.factory import make_plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.scenes.scene_spec import ObjectSpec
from dualbrain.simulation.tasks.arrival import ArrivalGoal
from dualbrain.simulation.tasks.multi_goal import GoalSequence, HomeGoal, HomeJudge, parse_goals
from dualbrain.simulation.tasks.placement import PlacementGoal, parse_goal
from dualbrain.simulation.world import SimulatedWorld
from dualbrain.skills.mobile_manipulator import LocalFrame
from dualbrain.skills.registry import skill_registry
from dualbrain.skills.skill import HeldObject

BODY = load_robot("mobile_panda")
GRASP = (
    "grasp",
    {
        "object": "red_cube",
        "force": 20.0,
        "speed": 0.2,
        "clearance": 0.1,
        "finger_axis": "along",
        "opening": 0.08,
        "approach": "top",
        "wait": "none",
    },
)
PLACE = ("place", {"destination": "blue_bowl", "speed": 0.2, "clearance": 0.12, "route": "direct", "wait": "none"})


def drive_to(place):
    return ("drive_to", {"place": place, "max_speed": 0.4, "max_turn_rate": 0.8})


def contract(*actions):
    return Contract("c-1", Context(BODY.name, ""), tuple(Action(skill, params) for skill, params in actions))


class MobileManipulatorCell:
    """A simulated workroom with the robot at base pose `at` (x [m], y [m], heading [rad])."""

    def __init__(self, scene="workroom:0", at=None):
        self.spec = open_scene(scene, BODY.name)
        self.plant = make_plant(self.spec, BODY)
        if at is not None:
            self.plant.set_configuration(np.array([*at, *BODY.home[3:]]))
        self.trace = Trace(BODY.n, BODY.nq)
        self.world = SimulatedWorld(self.plant, NoisyPerception(self.spec, PerceptionNoise(), np.random.default_rng(0)))
        self.executor = ContractExecutor(
            ControlLoop(
                BODY,
                self.plant,
                self.world,
                SafetyFilter(BODY),
                FlightLog(self.trace),
                ControlLoopConfig(settle_time=0.1),
                LoopObserver(on_phase=self.world.set_phase),
            )
        )

    def run(self, *actions):
        self.world.start_contract(contract(*actions))
        return self.executor.execute(contract(*actions))


def test_it_offers_what_a_base_and_an_arm_can_do():
    names = [skill.name for skill in skill_registry(BODY).skills]
    assert len(set(names)) == len(names)
    assert {"drive_to", "turn_to", "stop", "grasp", "place", "push", "home", "decline"} <= set(names)
    panda = skill_registry(load_robot("panda")).by_name
    assert skill_registry(BODY).by_name["grasp"] == panda["grasp"], "the skills of the arm are the same on a fixed base"


def test_it_drives_to_the_shelf_with_its_arm_at_home():
    spot = open_scene("workroom:0", BODY.name).find_place("shelf").position
    cell = MobileManipulatorCell(at=(spot[0] - 0.5, spot[1] + 0.1, 0.0))
    assert cell.run(drive_to("shelf")).kind == "succeeded"
    done = cell.world.judgement()
    assert done.success
    assert done.violations == ()
    arm = cell.plant.read().q[3:]
    assert np.abs(arm - BODY.home[3:]).max() < 5e-3


@pytest.mark.parametrize("height", [0.3, pytest.param(0.7, marks=pytest.mark.slow)])
def test_the_height_of_another_table_changes_no_grasp(monkeypatch, height):
    """The other table is the first support of the scene, behind the robot."""
    spec = open_scene("workroom:0", BODY.name)
    bench = spec.find_place("bench").position
    side = float(np.sign(bench[1]))
    desk = ObjectSpec(
        name="desk",
        role="support",
        shape=Box((0.3, 0.3, 0.5 * height)),
        position=(-0.6, -1.9 * side, 0.5 * height),
        mass=60.0,
        colour="oak",
        category="table",
        fixed=True,
    )
    two_tables = msgspec.structs.replace(spec, objects=(desk, *spec.objects))
    monkeypatch.setattr(sys.modules[__name__], "open_scene", lambda *_: two_tables)
    cell = MobileManipulatorCell(at=(bench[0], bench[1], side * 1.5708))
    before = cell.world.perceive().find("red_cube").pose.position[2]
    outcome = cell.run(GRASP)
    assert outcome.kind == "succeeded", outcome.reason
    assert cell.world.perceive().find("red_cube").pose.position[2] - before > 0.08
    assert outcome.h_min > 0.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_it_goes_to_the_table_and_puts_the_cube_in_the_bowl(seed):
    cell = MobileManipulatorCell(f"workroom:{seed}")
    side = np.sign(cell.spec.find_place("bench").position[1])
    turn = ("turn_to", {"heading": float(side * 1.5708), "max_turn_rate": 0.8})
    out = cell.run(drive_to("bench"), turn, GRASP, PLACE)
    assert out.kind == "succeeded", out.reason
    done = cell.world.judgement()
    assert done.success
    assert done.violations == ()


def test_the_gate_checks_reach_only_at_the_present_base_pose():
    """The cube is out of reach from the start pose; the base pose after a drive is not known at the gate."""
    scene = scene_from_spec(open_scene("workroom:0", BODY.name))
    rules = scene_rules(scene, controller_at_home(BODY.name, scene))
    at_once, later = contract(GRASP, PLACE), contract(drive_to("bench"), GRASP, PLACE)
    refused = [refusal for rule in rules if (refusal := rule(at_once)) is not None]
    assert "reach" in refused[0].hint
    assert all(rule(later) is None for rule in rules)
    assert any(rule(contract(drive_to("bench"), PLACE)) is not None for rule in rules), "a place needs a held object"


def test_the_gate_does_not_check_reach_in_the_heading_before_a_turn():
    """In front of the bench the cube is out of reach while the base is turned away, and within reach after a turn."""
    spot = open_scene("workroom:0", BODY.name).find_place("bench").position
    refusals = {}
    for heading in (-1.57, 1.57):
        loop = MobileManipulatorCell(at=(spot[0], spot[1] - 0.15, heading)).executor.loop
        rules = scene_rules(loop.scene, loop.controller)
        turn = ("turn_to", {"heading": 1.57, "max_turn_rate": 0.8})
        for actions in ((GRASP, PLACE), (turn, GRASP, PLACE)):
            found = [refusal.hint for rule in rules if (refusal := rule(contract(*actions)))]
            refusals[heading, actions[0][0]] = found
    assert [hint for hint in refusals.pop((-1.57, "grasp")) if "out of reach" in hint]
    assert not any(refusals.values())


@pytest.mark.parametrize("seed", range(4))
def test_an_object_out_of_reach_from_the_place_driven_to_is_refused_at_the_gate(seed):
    scene = scene_from_spec(open_scene(f"workroom:{seed}", BODY.name))
    rules = scene_rules(scene, controller_at_home(BODY.name, scene))
    out_of_reach = contract(drive_to("shelf"), GRASP, PLACE)
    refused = [refusal for rule in rules if (refusal := rule(out_of_reach)) is not None]
    assert refused[0].pointer == "/action_sequence/1/params/object"
    assert refused[0].allowed == {"reached from": ["bench"]}
    assert "drive_to bench" in refused[0].hint
    assert all(rule(contract(drive_to("shelf"), drive_to("bench"), GRASP, PLACE)) is None for rule in rules)
    home = ("home", {"speed": 0.2})
    place_elsewhere = contract(drive_to("bench"), GRASP, home, drive_to("shelf"), PLACE)
    refused = [refusal for rule in rules if (refusal := rule(place_elsewhere)) is not None]
    assert [refusal.pointer for refusal in refused] == ["/action_sequence/4/params/destination"]


def test_the_gate_checks_the_reach_of_a_moved_object_where_the_contract_put_it():
    """The bowl is at the shelf, the cube at the bench; a pushed or released cube is at no known position."""
    scene = scene_from_spec(open_scene("workroom:0", BODY.name))
    shelf = next(place.position for place in scene.places if place.name == "shelf")
    objects = tuple(
        msgspec.structs.replace(obj, pose=Pose((*shelf[:2], obj.pose.position[2]))) if obj.name == "blue_bowl" else obj
        for obj in scene.objects
    )
    scene = msgspec.structs.replace(scene, objects=objects)
    rules = scene_rules(scene, controller_at_home(BODY.name, scene))

    def pointers(*actions):
        return [refusal.pointer for rule in rules if (refusal := rule(contract(*actions)))]

    moved = (drive_to("bench"), GRASP, drive_to("shelf"), PLACE)
    assert not pointers(*moved, GRASP, PLACE)
    assert pointers(*moved, drive_to("bench"), GRASP, PLACE) == ["/action_sequence/5/params/object"]
    release = ("release", {"speed": 0.1})
    assert not pointers(drive_to("bench"), GRASP, drive_to("shelf"), release, GRASP, PLACE)
    assert pointers(drive_to("bench"), GRASP, PLACE) == ["/action_sequence/2/params/destination"]


def test_an_opening_that_is_too_small_is_refused_at_the_gate_also_after_a_drive():
    """The width of an object does not depend on the pose of the base."""
    scene = scene_from_spec(open_scene("workroom:0", BODY.name))
    rules = scene_rules(scene, controller_at_home(BODY.name, scene))
    narrow = ("grasp", GRASP[1] | {"opening": 0.03})
    refused = [refusal for rule in rules if (refusal := rule(contract(drive_to("bench"), narrow, PLACE)))]
    assert [refusal.pointer for refusal in refused] == ["/action_sequence/1/params/opening"]
    assert all(rule(contract(drive_to("bench"), GRASP, PLACE)) is None for rule in rules)


def test_the_base_observes_the_object_in_the_hand():
    scene = scene_from_spec(open_scene("workroom:0", BODY.name))
    robot = controller_at_home(BODY.name, scene)
    for held in (HeldObject("red_cube", 0.03), None):
        robot.holding = held
        robot.observe(robot.observation)
        assert robot.base.holding is held


def test_a_container_is_no_driving_destination():
    scene = scene_from_spec(open_scene("workroom:0", BODY.name))
    rules = scene_rules(scene, controller_at_home(BODY.name, scene))
    into_the_bowl = contract(drive_to("blue_bowl"))
    refused = [refusal for rule in rules if (refusal := rule(into_the_bowl)) is not None]
    assert refused[0].allowed == ["shelf", "charger", "bench"]
    assert all(rule(contract(drive_to("bench"))) is None for rule in rules)


def test_goals_about_places_and_about_objects_are_parsed_in_the_same_scene():
    spec = open_scene("workroom:0", BODY.name)
    assert parse_goal("go to the bench", spec) == ArrivalGoal("bench")
    assert parse_goal("put the red cube in the blue bowl", spec) == PlacementGoal("red_cube", "blue_bowl")
    both = parse_goals("go to the shelf, then put the red cube in the blue bowl, then go home", spec)
    assert both == GoalSequence(((ArrivalGoal("shelf"),), (PlacementGoal("red_cube", "blue_bowl"),), (HomeGoal(),)))


def test_the_home_goal_concerns_only_the_arm():
    cell = MobileManipulatorCell(at=(1.0, 0.5, 0.3))
    judge = HomeJudge(cell.plant)
    assert judge.score()[0]
    cell.plant.set_configuration(np.array([1.0, 0.5, 0.3, *(BODY.home[3:] + np.eye(7)[0] * 0.3)]))
    assert not judge.score()[0]


def test_the_local_frame_transforms_the_scene_to_the_base_of_the_arm():
    """The origin is below the first axis of the arm, on the support; orientations of objects are transformed too."""
    scene = scene_from_spec(open_scene("workroom:0", BODY.name))
    rotation = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    local = LocalFrame(rotation, np.array([2.0, 1.0, 0.5])).localize_scene(scene)
    cube, local_cube = scene.find("red_cube"), local.find("red_cube")
    x, y, z = cube.pose.position
    np.testing.assert_allclose(local_cube.pose.position, (y - 1.0, -(x - 2.0), z - 0.5), atol=1e-12)
    assert local_cube.pose.quaternion != cube.pose.quaternion
    assert LocalFrame(np.eye(3), np.zeros(3)).localize_scene(scene).find("table").pose.quaternion == pytest.approx(
        IDENTITY_QUATERNION
    )
    assert local.region == ()


def test_a_robot_with_disabled_drives_stops():
    plant = make_plant(open_scene("workroom:0", BODY.name), BODY)
    for _ in range(150):
        plant.write(Command(np.array([0.3, 0.4, 0.3, *np.zeros(6)]), 0.04, 5.0))
        plant.advance()
    assert plant.read().v[0] > 0.2
    plant.stop()
    for _ in range(300):
        plant.advance()
    assert np.abs(plant.read().v).max() < 2e-3
    assert not plant.read().drive_enabled
    plant.enable()
    assert plant.read().drive_enabled


def test_the_tracking_error_of_the_plant_is_within_the_model():
    """|∫ exp(−α (t − s)) (ẏ − u) ds| ≤ e for arm and base, each with its own lag, at full acceleration."""
    plant, rng = make_plant(open_scene("empty_room:0", BODY.name), BODY), np.random.default_rng(0)
    plant.set_configuration(np.array([2.0, 0.0, 0.5, *BODY.home[3:]]))
    v_max, a_max = (np.array([getattr(j, side).value for j in BODY.joints]) for side in ("velocity", "acceleration"))
    lag = BODY.tracking.lag + np.array([BODY.base_lag] * 2 + [0.0] * 7)
    keep, gap, u, before = np.exp(-BODY.tracking.rate * BODY.period), np.zeros(9), np.zeros(9), plant.read()
    for step in range(1500):
        if step % 150 == 0:
            wanted = rng.uniform(-1.0, 1.0, 9) * v_max * 0.4
        u = u + np.clip(wanted - u, -a_max * BODY.period, a_max * BODY.period)
        plant.write(Command(u, 0.04, 5.0))
        plant.advance()
        after = plant.read()
        gap = keep * gap + control_displacement(before.q, after.q) + lag * (after.v - before.v) - u * BODY.period
        before = after
        assert np.abs(gap).max() <= BODY.tracking.position_error
