"""What judges call the things that eyes have named themselves."""

import msgspec
import numpy as np

from dualbrain.robots.loader import load_robot
from dualbrain.simulation.perception.noisy_perception import NO_NOISE, NoisyPerception
from dualbrain.simulation.plant.factory import make_plant
from dualbrain.simulation.scenes.generators.tabletop import make_scene
from dualbrain.simulation.world import SimulatedWorld, match_true_names


class Naming:
    """Sees everything where it is, and calls things as it likes; two of them by each other's names."""

    def __init__(self, spec, names):
        self._eyes, self._names = NoisyPerception(spec, NO_NOISE, np.random.default_rng(0)), names

    def perceive(self, plant):
        scene = self._eyes.perceive(plant)
        things = (msgspec.structs.replace(one, name=self._names.get(one.name, one.name)) for one in scene.objects)
        return msgspec.structs.replace(scene, objects=tuple(things))


def world(names):
    spec = make_scene("tabletop", 1)
    plant = make_plant(spec, load_robot("panda"), visuals=False)
    return SimulatedWorld(plant, Naming(spec, names))


def test_names_that_the_plant_knows_are_taken_as_they_are():
    here = world({})
    assert match_true_names(here.perceive(), here.plant) == {}


def test_what_has_another_name_is_the_true_thing_where_it_is_seen():
    names = {"red_cube": "orange_block", "blue_bowl": "red_cube"}
    here = world(names)
    found = match_true_names(here.perceive(), here.plant)
    assert {found[names.get(name, name)] == name for name in here.plant.object_names} == {True}


def test_what_a_map_closes_is_nothing_that_was_seen():
    spec = make_scene("tabletop", 1)
    plant = make_plant(spec, load_robot("panda"), visuals=False)
    scene = NoisyPerception(spec, NO_NOISE, np.random.default_rng(0)).perceive(plant)
    closed = msgspec.structs.replace(scene.find("red_cube"), name="closed", role="obstacle")
    assert match_true_names(msgspec.structs.replace(scene, objects=(*scene.objects, closed)), plant) == {}


def test_the_monitor_allows_the_true_thing_under_any_name():
    here = world({"red_cube": "orange_block"})
    here.perceive()
    told = []
    here.monitor.allow = lambda *given: told.append(given)
    here.set_phase("grasp", {"target": "orange_block", "held": None, "destination": "table_left"})
    here.set_phase("lift", {"target": None, "held": "orange_block", "destination": None})
    assert told[0][:2] == ("red_cube", None)
    assert told[1][:2] == (None, "red_cube")
