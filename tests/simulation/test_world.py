"""The simulated world: true names of perceived objects, and the goal of a contract."""

import msgspec
import numpy as np
import pytest

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.errors import ConfigurationError
from dualbrain.robots.loader import load_robot
from dualbrain.simulation.perception.noisy_perception import NO_NOISE, NoisyPerception
from dualbrain.simulation.plant.factory import make_plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.scenes.generators.tabletop import make_scene
from dualbrain.simulation.tasks.multi_goal import GoalSequence
from dualbrain.simulation.tasks.placement import PlacementGoal
from dualbrain.simulation.world import SimulatedWorld, contract_goals, match_true_names
from dualbrain.simulation.world import make_world as world_of_scene


class RenamingPerception:
    """Perceives exact poses and replaces names by `names`."""

    def __init__(self, spec, names):
        self._perception, self._names = NoisyPerception(spec, NO_NOISE, np.random.default_rng(0)), names

    def perceive(self, plant):
        scene = self._perception.perceive(plant)
        objects = (msgspec.structs.replace(one, name=self._names.get(one.name, one.name)) for one in scene.objects)
        return msgspec.structs.replace(scene, objects=tuple(objects))


def renaming_world(names):
    spec = make_scene("tabletop", 1)
    plant = make_plant(spec, load_robot("panda"), visuals=False)
    return SimulatedWorld(plant, RenamingPerception(spec, names))


def test_names_of_the_plant_are_not_changed():
    world = renaming_world({})
    assert match_true_names(world.perceive(), world.plant) == {}


def test_an_object_with_another_name_is_matched_by_its_position():
    names = {"red_cube": "orange_block", "blue_bowl": "red_cube"}
    world = renaming_world(names)
    found = match_true_names(world.perceive(), world.plant)
    assert {found[names.get(name, name)] == name for name in world.plant.object_names} == {True}


def test_a_keep_out_area_is_not_matched():
    spec = make_scene("tabletop", 1)
    plant = make_plant(spec, load_robot("panda"), visuals=False)
    scene = NoisyPerception(spec, NO_NOISE, np.random.default_rng(0)).perceive(plant)
    closed = msgspec.structs.replace(scene.find("red_cube"), name="closed", role="obstacle")
    assert match_true_names(msgspec.structs.replace(scene, objects=(*scene.objects, closed)), plant) == {}


def test_the_monitor_permits_contact_with_the_true_object_under_any_name():
    world = renaming_world({"red_cube": "orange_block"})
    world.perceive()
    calls = []
    world.monitor.allow = lambda *arguments: calls.append(arguments)
    world.set_phase("grasp", {"target": "orange_block", "held": None, "destination": "table_left"})
    world.set_phase("lift", {"target": None, "held": "orange_block", "destination": None})
    assert calls[0][:2] == ("red_cube", None)
    assert calls[1][:2] == (None, "red_cube")


@pytest.mark.parametrize(("offset", "success"), [(0.0, True), (0.3, False)])
def test_a_contract_that_only_goes_home_succeeds_when_the_arm_rests_at_home(offset, success):
    panda = load_robot("panda")
    world = world_of_scene(open_scene("bare:1"), panda)
    world.start_contract(Contract("c-0001", Context("panda", ""), (Action("home", {"speed": 0.2}),)))
    world.plant.set_configuration(np.array(panda.home) + offset, 0.04)
    assert world.judgement().success == success


@pytest.mark.parametrize(
    ("obj", "destination", "judged"),
    [
        ("red_cube", "blue_bowl", True),
        ("ghost", "blue_bowl", False),
        ("red_cube", "moon", False),
        ("red_cube", "red_cube", False),
    ],
)
def test_a_goal_with_a_name_that_is_not_in_the_scene_is_not_judged(obj, destination, judged):
    world = world_of_scene(open_scene("bare:1"), load_robot("panda"))
    steps = (Action("grasp", {"object": obj}), Action("place", {"destination": destination}))
    world.start_contract(Contract("c-0001", Context("panda", ""), steps))
    judgement = world.judgement()
    assert (judgement.success, judgement.judged) == (False, judged)


def test_home_after_a_placement_leaves_the_goal_of_the_placement():
    grasp, place = Action("grasp", {"object": "red_cube"}), Action("place", {"destination": "blue_bowl"})
    contract = Contract("c-0001", Context("panda", ""), (grasp, place, Action("home", {})))
    assert contract_goals(contract) == PlacementGoal("red_cube", "blue_bowl")


def steps(*pairs):
    """A contract that grasps and places each of `pairs` of object and destination."""
    actions = ((Action("grasp", {"object": obj}), Action("place", {"destination": to})) for obj, to in pairs)
    return Contract("c-0001", Context("panda", ""), tuple(one for pair in actions for one in pair))


def test_the_last_placement_of_an_object_counts():
    once = steps(("red_cube", "table_left"), ("red_cube", "blue_bowl"))
    assert contract_goals(once) == PlacementGoal("red_cube", "blue_bowl")
    between = steps(("red_cube", "table_left"), ("glass", "table_right"), ("red_cube", "blue_bowl"))
    expected = (PlacementGoal("glass", "table_right"),), (PlacementGoal("red_cube", "blue_bowl"),)
    assert contract_goals(between) == GoalSequence(expected)


def test_the_goal_of_a_contract_with_perceived_names_is_that_of_the_true_objects():
    world = renaming_world({"red_cube": "orange_block", "blue_bowl": "dish"})
    world.perceive()
    world.start_contract(steps(("orange_block", "dish")))
    assert world.judgement().judged
    assert world._judge.goal == PlacementGoal("red_cube", "blue_bowl")


def test_a_negative_seed_is_refused():
    with pytest.raises(ConfigurationError, match="seed: got -1, allowed: 0 or more"):
        world_of_scene(open_scene("bare:0"), load_robot("panda"), seed=-1)
