"""A camera that hangs: repeated scenes with new stamps are detected; noisy measurements never cause a false alarm."""

import msgspec
import numpy as np
import pytest

from dualbrain.control.scene_monitor import SceneMonitor
from dualbrain.core.geometry.shapes import Pose
from dualbrain.robots.loader import load_robot
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.state_monitor import MonitorLimits
from dualbrain.simulation.perception.noisy_perception import NO_NOISE, NoisyPerception, PerceptionNoise
from dualbrain.simulation.plant.factory import make_plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from tests.grounding.perceived_scenes import box, forearm, scene

FROZEN = int(Condition.SCENE_FROZEN)
PERIOD = 0.033
MAX_IDENTICAL = MonitorLimits().max_identical_scenes
NOISES = (
    PerceptionNoise(),
    PerceptionNoise(correlation_time=0.0),
    PerceptionNoise(correlation_time=50.0),
    PerceptionNoise(latency=0.08),
    PerceptionNoise(dropout_probability=0.5),
    PerceptionNoise(sigma=0.0),
    PerceptionNoise(velocity_error=0.0),
    NO_NOISE,
)


def repeated_scenes(objects, count, start=0, *, new_stamps=True):
    """`count` scenes with the same objects, whose stamps are those of the scenes or 0."""
    for k in range(start, start + count):
        now = PERIOD * k
        stamped = [msgspec.structs.replace(one, stamp=now if new_stamps else 0.0) for one in objects]
        yield msgspec.structs.replace(scene(*stamped), stamp=now)


def monitored(*scenes):
    """The monitor after the scenes, and the conditions of the last one."""
    monitor, conditions = SceneMonitor(), 0
    for perceived in scenes:
        conditions = monitor.update(perceived)
    return monitor, conditions


CUBE = box("red_cube", 0.5, -0.2, error=0.009)
ARM = msgspec.structs.replace(forearm(0.7, 0.2, (0.0, 0.1, 0.0)), error=0.009, velocity_error=0.02)


@pytest.mark.parametrize("objects", [(CUBE,), (ARM,), (CUBE, ARM)], ids=["an object", "a person", "both"])
def test_a_scene_that_repeats_is_not_accepted(objects):
    assert monitored(*repeated_scenes(objects, MAX_IDENTICAL))[1] == 0
    monitor, conditions = monitored(*repeated_scenes(objects, MAX_IDENTICAL + 1))
    assert conditions == FROZEN
    (last,) = repeated_scenes(objects, 1, MAX_IDENTICAL)
    assert monitor.age_conditions(last, PERIOD * (MAX_IDENTICAL + 0.5)) & FROZEN, "between two scenes, too"


def test_the_condition_ends_with_the_first_scene_that_differs():
    monitor, _ = monitored(*repeated_scenes((CUBE, ARM), MAX_IDENTICAL + 3))
    moved = [
        msgspec.structs.replace(one, pose=Pose(tuple(np.add(one.pose.position, 1e-9).tolist()), one.pose.quaternion))
        for one in (CUBE, ARM)
    ]
    (other,) = repeated_scenes(moved, 1, MAX_IDENTICAL + 3)
    assert monitor.update(other) == 0
    assert monitor.age_conditions(other, other.stamp) == 0


def test_one_repeated_person_among_changing_objects_is_detected():
    monitor, conditions = SceneMonitor(), 0
    for k in range(MAX_IDENTICAL + 1):
        cube = box("red_cube", 0.5 + 1e-6 * k, -0.2, error=0.009, stamp=PERIOD * k)
        arm = msgspec.structs.replace(ARM, stamp=PERIOD * k)
        conditions = monitor.update(msgspec.structs.replace(scene(cube, arm), stamp=PERIOD * k))
    assert conditions == FROZEN


def test_an_object_without_noise_or_without_a_new_stamp_may_repeat():
    exact = box("post", 0.6, 0.3)
    assert monitored(*repeated_scenes((exact,), 50))[1] == 0
    assert monitored(*repeated_scenes((CUBE,), 50, new_stamps=False))[1] == 0


def test_a_scene_in_which_a_name_is_used_twice_is_not_accepted():
    """A grasp of one of two objects with one name would remove both from the obstacles."""
    other = box("red_cube", 0.3, 0.2, error=0.009)
    assert monitored(scene(CUBE, box("blue_cube", 0.3, 0.2, error=0.009)))[1] == 0
    assert monitored(scene(CUBE, other))[1] == Condition.SCENE_IMPLAUSIBLE
    assert monitored(scene(CUBE, places=(("red_cube", (0.3, 0.2, 0.0)),)))[1] == Condition.SCENE_IMPLAUSIBLE
    assert monitored(scene(CUBE, places=(("left", (0.3, 0.2, 0.0)),) * 2))[1] == Condition.SCENE_IMPLAUSIBLE


@pytest.mark.parametrize("noise", NOISES, ids=str)
@pytest.mark.parametrize("name", ["tabletop:1", "forearm:0"])
def test_the_simulated_perception_never_causes_a_false_alarm(noise, name):
    spec, robot_model = open_scene(name, "panda"), load_robot("panda")
    plant = make_plant(spec, robot_model, visuals=False)
    perception, monitor = NoisyPerception(spec, noise, np.random.default_rng(0)), SceneMonitor()
    for _ in range(20):
        perceived = perception.perceive(plant)
        assert not (monitor.update(perceived) | monitor.age_conditions(perceived, plant.now)) & FROZEN
        for _ in range(33):
            plant.advance()
