"""Skills in the physics of the bare scene: δ is 0 on every tick, things are lifted and held, and truth agrees."""

import msgspec
import numpy as np
import pytest

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.control.contract_executor import ContractExecutor
from dualbrain.control.control_loop import ControlLoop, ControlLoopConfig, LoopObserver
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Trace
from dualbrain.core.geometry.shapes import Pose
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.simulation.perception.noisy_perception import NO_NOISE, NoisyPerception, PerceptionNoise
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.tabletop import make_scene
from dualbrain.simulation.world import SimulatedWorld
from tests.stories.story_session import GRASP, PLACE


class SkillCell:
    """A scene, an arm and a local layer, without planner and memory."""

    def __init__(self, family="bare", seed=0, noise=NO_NOISE, ghost=None, robot="panda"):
        self.spec, robot_model = make_scene(family, seed, robot), load_robot(robot)
        self.plant = Plant(self.spec, robot_model)
        self.trace = Trace(robot_model.n)
        world = SimulatedWorld(self.plant, NoisyPerception(self.spec, noise, np.random.default_rng(seed)))
        self.world = Ghosts(world, ghost) if ghost else world
        self.monitor = world.monitor
        self.layer = ContractExecutor(
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
        return self.layer.execute(Contract("c-1", Context(self.spec.robot, ""), sequence))

    def untouched(self):
        """Whether δ was 0 on every tick."""
        return not np.any(self.trace["delta"])


class Ghosts:
    """Surroundings in which one thing is seen where it is not."""

    def __init__(self, world, ghost):
        self._world, self._ghost = world, ghost

    def look(self):
        scene = self._world.look()
        name, position = self._ghost
        things = tuple(
            msgspec.structs.replace(thing, pose=Pose(position)) if thing.name == name else thing
            for thing in scene.objects
        )
        return msgspec.structs.replace(scene, objects=things)

    def advance(self):
        self._world.advance()


def grasp(**changes):
    return ("grasp", {**GRASP, **changes})


def place(**changes):
    return ("place", {**PLACE, **changes})


PICKS = [
    (0, NO_NOISE, {}),
    (1, PerceptionNoise(), {"speed": 0.4}),
    (2, NO_NOISE, {"finger_axis": "across", "clearance": 0.25}),
    (3, PerceptionNoise(), {"finger_axis": "across", "opening": 0.08}),
    (4, NO_NOISE, {"approach": "tilted", "speed": 0.35}),
    (5, PerceptionNoise(), {"force": 10.0, "speed": 0.3}),
]


@pytest.mark.parametrize(("seed", "noise", "changes"), PICKS)
def test_a_pick_lifts_and_holds_and_the_filter_has_nothing_to_do(seed, noise, changes):
    bench = SkillCell(seed=seed, noise=noise)
    outcome = bench.run(grasp(**changes), ("hold", {"duration": 0.5}))
    assert outcome.kind == "succeeded", outcome.reason
    assert bench.plant.true_pose("red_cube").position[2] > 0.05
    assert min(bench.plant.read().finger_forces) > 0.5
    assert bench.untouched()
    assert outcome.Delta == 0.0
    assert bench.monitor.violations() == ()


CONTRACTS = [
    (NO_NOISE, (grasp(speed=0.4), place(speed=0.4, route="near_base"))),
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
def test_whole_contracts_on_the_bare_scene_complete_with_delta_zero_on_every_tick(noise, actions):
    bench = SkillCell(seed=7, noise=noise)
    outcome = bench.run(*actions)
    assert outcome.kind == "succeeded", outcome.reason
    assert {action.status for action in outcome.actions} == {"done"}
    assert bench.untouched()
    assert bench.monitor.violations() == ()


def test_a_grasp_with_nothing_there_fails_the_two_finger_test():
    bench = SkillCell(ghost=("red_cube", (0.5, 0.0, 0.025)))
    outcome = bench.run(grasp(speed=0.4), place())
    assert outcome.kind == "failed"
    assert "two-finger test" in outcome.reason
    assert [action.status for action in outcome.actions] == ["failed", "not_run"]
    assert bench.layer.loop.controller.holding is None


def test_the_order_of_actions_is_kept_and_a_failure_ends_it():
    bench = SkillCell()
    outcome = bench.run(("hold", {"duration": 0.5}), place(), ("hold", {"duration": 5.0}))
    assert [action.status for action in outcome.actions] == ["done", "failed", "not_run"]
    assert "nothing is held" in outcome.reason
    assert outcome.duration < 1.0


def move_to(target, **changes):
    return (
        "move_to",
        {"target": target, "speed": 0.2, "clearance": 0.15, "route": "direct", "wait": "none", **changes},
    )


@pytest.mark.parametrize(
    "journey",
    [
        ("red_cube", {"speed": 0.4, "clearance": 0.35, "route": "left"}),
        ("blue_bowl", {"clearance": 0.03, "route": "near_base"}),
        ("table_left", {"speed": 0.4, "route": "right"}),
    ],
    ids=lambda journey: journey[0],
)
def test_going_above_things_and_places_is_left_alone(journey):
    bench = SkillCell(seed=3, noise=PerceptionNoise())
    outcome = bench.run(move_to(journey[0], **journey[1]))
    assert (outcome.kind, bench.untouched()) == ("succeeded", True)
    assert bench.monitor.violations() == ()


def test_a_long_errand_with_every_other_skill_is_left_alone():
    bench = SkillCell(seed=1, noise=PerceptionNoise())
    home = ("home", {"speed": 0.4})
    outcome = bench.run(
        grasp(clearance=0.1),
        ("hold", {"duration": 0.5}),
        home,
        move_to("table_left", clearance=0.03),
        ("release", {"speed": 0.2}),
        home,
    )
    assert [action.status for action in outcome.actions] == ["done"] * 6, outcome.reason
    assert bench.untouched()
    assert not [one for one in bench.monitor.violations() if one.kind != "object_dropped"]
