"""Skills in simulation on the bare scene: δ is 0 on every tick, and objects are lifted and held in the true state."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.control.contract_executor import ContractExecutor
from dualbrain.control.control_loop import ControlLoop, ControlLoopConfig, LoopObserver
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Trace
from dualbrain.core.geometry.shapes import Pose
from dualbrain.errors import GeometryError
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.simulation.perception.noisy_perception import NO_NOISE, NoisyPerception, PerceptionNoise
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.tabletop import make_scene
from dualbrain.simulation.world import SimulatedWorld
from tests.stories.story_session import GRASP, PLACE


class SkillCell:
    """A simulated arm with contract executor and safety filter, without planner and memory."""

    def __init__(self, family="bare", seed=0, noise=NO_NOISE, ghost=None, robot="panda"):
        self.spec, robot_model = make_scene(family, seed, robot), load_robot(robot)
        self.plant = Plant(self.spec, robot_model)
        self.trace = Trace(robot_model.n)
        world = SimulatedWorld(self.plant, NoisyPerception(self.spec, noise, np.random.default_rng(seed)))
        self.world = MisplacedObject(world, ghost) if ghost else world
        self.monitor = world.monitor
        self.executor = ContractExecutor(
            ControlLoop(
                robot_model,
                self.plant,
                self.world,
                SafetyFilter(robot_model),
                FlightLog(self.trace),
                ControlLoopConfig(settle_time=0.1),
                LoopObserver(on_phase=world.set_phase),
            )
        )

    def run(self, *actions):
        sequence = tuple(Action(skill, params) for skill, params in actions)
        return self.executor.execute(Contract("c-1", Context(self.spec.robot, ""), sequence))

    def filter_never_intervened(self):
        """Whether δ was 0 on every tick."""
        return not np.any(self.trace["delta"])


class MisplacedObject:
    """A world in which one object is perceived at a wrong position; `ghost` is its name and that position [m]."""

    def __init__(self, world, ghost):
        self._world, self._ghost = world, ghost

    def perceive(self):
        scene = self._world.perceive()
        name, position = self._ghost
        objects = tuple(
            msgspec.structs.replace(obj, pose=Pose(position)) if obj.name == name else obj for obj in scene.objects
        )
        return msgspec.structs.replace(scene, objects=objects)

    def advance(self):
        self._world.advance()


def grasp(**changes):
    return ("grasp", {**GRASP, **changes})


def place(**changes):
    return ("place", {**PLACE, **changes})


GRASPS = [
    (0, NO_NOISE, {}),
    (1, PerceptionNoise(), {"speed": 0.4}),
    pytest.param(2, NO_NOISE, {"finger_axis": "across", "clearance": 0.25}, marks=pytest.mark.slow),
    (3, PerceptionNoise(), {"finger_axis": "across", "opening": 0.08}),
    (4, NO_NOISE, {"approach": "tilted", "speed": 0.35}),
    pytest.param(5, PerceptionNoise(), {"force": 10.0, "speed": 0.3}, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("seed", "noise", "changes"), GRASPS)
def test_a_grasp_lifts_and_holds_the_object_without_filter_intervention(seed, noise, changes):
    cell = SkillCell(seed=seed, noise=noise)
    outcome = cell.run(grasp(**changes), ("hold", {"duration": 0.5}))
    assert outcome.kind == "succeeded", outcome.reason
    assert cell.plant.true_pose("red_cube").position[2] > 0.05
    assert min(cell.plant.read().finger_forces) > 0.5
    assert cell.filter_never_intervened()
    assert outcome.Delta == 0.0
    assert cell.monitor.violations() == ()


CONTRACTS = [
    pytest.param(NO_NOISE, (grasp(speed=0.4), place(speed=0.4, route="near_base")), marks=pytest.mark.slow),
    (
        PerceptionNoise(),
        (grasp(speed=0.4), place(destination="table_left", speed=0.4, clearance=0.2), ("home", {"speed": 0.4})),
    ),
    (
        NO_NOISE,
        (("move_to", {"target": "blue_bowl", "speed": 0.4, "clearance": 0.1, "route": "left", "wait": "none"}),),
    ),
]


@pytest.mark.parametrize(("noise", "actions"), CONTRACTS)
def test_contracts_on_the_bare_scene_succeed_with_delta_zero_on_every_tick(noise, actions):
    cell = SkillCell(seed=7, noise=noise)
    outcome = cell.run(*actions)
    assert outcome.kind == "succeeded", outcome.reason
    assert {action.status for action in outcome.actions} == {"done"}
    assert cell.filter_never_intervened()
    assert cell.monitor.violations() == ()


def test_a_grasp_of_a_missing_object_fails_the_two_finger_test():
    cell = SkillCell(ghost=("red_cube", (0.5, 0.0, 0.025)))
    outcome = cell.run(grasp(speed=0.4), place())
    assert outcome.kind == "failed"
    assert "two-finger test" in outcome.reason
    assert [action.status for action in outcome.actions] == ["failed", "not_run"]
    assert cell.executor.loop.controller.holding is None


@pytest.mark.parametrize("offset", [0.016, 0.028])
def test_a_finger_that_meets_the_object_from_above_neither_tilts_nor_pushes_it(offset):
    """The object is perceived beside its place, so that a finger descends onto its top."""
    x, y, z = SkillCell().plant.true_pose("red_cube").position
    cell, tilts = SkillCell(ghost=("red_cube", (x + offset, y, z))), []
    write = cell.plant.write

    def record(command):
        if cell.executor.loop.phase == "descend":
            up = cell.plant.data.body("red_cube").xmat[8]
            tilts.append(np.degrees(np.arccos(min(1.0, up))))
        write(command)

    cell.plant.write = record
    outcome = cell.run(grasp(opening=0.06, clearance=0.1))
    assert outcome.kind != "succeeded"
    assert max(tilts) < 1.0


def test_actions_run_in_order_and_a_failure_ends_the_contract():
    cell = SkillCell()
    outcome = cell.run(("hold", {"duration": 0.5}), place(), ("hold", {"duration": 5.0}))
    assert [action.status for action in outcome.actions] == ["done", "failed", "not_run"]
    assert "nothing is held" in outcome.reason
    assert outcome.duration < 1.0


def move_to(target, **changes):
    return (
        "move_to",
        {"target": target, "speed": 0.2, "clearance": 0.15, "route": "direct", "wait": "none", **changes},
    )


@pytest.mark.parametrize(
    ("target", "changes"),
    [
        ("red_cube", {"speed": 0.4, "clearance": 0.35, "route": "left"}),
        ("blue_bowl", {"clearance": 0.03, "route": "near_base"}),
        ("table_left", {"speed": 0.4, "route": "right"}),
    ],
    ids=("red_cube", "blue_bowl", "table_left"),
)
def test_moving_above_objects_and_places_needs_no_filter_intervention(target, changes):
    cell = SkillCell(seed=3, noise=PerceptionNoise())
    outcome = cell.run(move_to(target, **changes))
    assert (outcome.kind, cell.filter_never_intervened()) == ("succeeded", True)
    assert cell.monitor.violations() == ()


def test_a_long_contract_with_the_other_skills_needs_no_filter_intervention():
    cell = SkillCell(seed=1, noise=PerceptionNoise())
    home = ("home", {"speed": 0.4})
    outcome = cell.run(
        grasp(clearance=0.1),
        ("hold", {"duration": 0.5}),
        home,
        move_to("table_left", clearance=0.03),
        ("release", {"speed": 0.2}),
        home,
    )
    assert [action.status for action in outcome.actions] == ["done"] * 6, outcome.reason
    assert cell.filter_never_intervened()
    assert not [violation for violation in cell.monitor.violations() if violation.kind != "object_dropped"]


def test_a_first_scene_that_is_not_usable_is_refused(monkeypatch):
    """An object from the future would have no margin for its age."""
    perceive = SimulatedWorld.perceive

    def from_the_future(world):
        scene = perceive(world)
        objects = tuple(msgspec.structs.replace(obj, stamp=scene.stamp + 10.0) for obj in scene.objects)
        return msgspec.structs.replace(scene, objects=objects)

    monkeypatch.setattr(SimulatedWorld, "perceive", from_the_future)
    with pytest.raises(GeometryError, match="after the stamp of the scene"):
        SkillCell()


@pytest.mark.parametrize("hidden_from", ["approach", "close", pytest.param("carry", marks=pytest.mark.slow)])
def test_an_object_that_the_hand_hides_is_still_known(hidden_from):
    """The cube is not in the scene from a phase on; the fingers feel it, and it is placed, which nothing confirms."""
    cell = SkillCell(seed=1)
    loop, perceive, hidden = cell.executor.loop, cell.world.perceive, []

    def perceive_without():
        scene = perceive()
        hidden.extend(["red_cube"] if loop.phase == hidden_from else [])
        return msgspec.structs.replace(scene, objects=tuple(obj for obj in scene.objects if obj.name not in hidden))

    cell.world.perceive = perceive_without
    outcome = cell.run(grasp(), place())
    assert [action.status for action in outcome.actions] == ["done", "failed"], outcome.reason
    assert "red_cube" in outcome.reason
    assert cell.plant.read().drive_enabled
    assert "red_cube" not in {obj.name for obj in loop.scene.objects} or not loop.held_object


def test_short_gaps_of_a_finger_force_are_no_lost_load():
    """While the load is carried, one finger is felt in every tenth state only."""
    cell = SkillCell(seed=1)
    loop, read = cell.executor.loop, cell.plant.read
    cell.run(grasp())

    def read_with_gaps():
        state = read()
        is_gap = loop.phase == "carry" and state.sequence % 10 != 0
        return replace(state, finger_forces=(0.3, state.finger_forces[1])) if is_gap else state

    cell.plant.read = read_with_gaps
    outcome = cell.run(place())
    assert outcome.kind == "succeeded", outcome.reason
