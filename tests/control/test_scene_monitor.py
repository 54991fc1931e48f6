"""A camera that hangs: the same picture stamped anew is found out, whatever is seen with noise never looks like it."""

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
LOOK = 0.033
ENOUGH = MonitorLimits().max_identical_scenes
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


def told(things, count, start=0, *, anew=True):
    """The same things in so many pictures, each stamped anew or not."""
    for k in range(start, start + count):
        now = LOOK * k
        stamped = [msgspec.structs.replace(one, stamp=now if anew else 0.0) for one in things]
        yield msgspec.structs.replace(scene(*stamped), stamp=now)


def watched(*pictures):
    """The watch after the pictures, and its last word."""
    watch, said = SceneMonitor(), 0
    for picture in pictures:
        said = watch.update(picture)
    return watch, said


CUBE = box("red_cube", 0.5, -0.2, error=0.009)
ARM = msgspec.structs.replace(forearm(0.7, 0.2, (0.0, 0.1, 0.0)), error=0.009, velocity_error=0.02)


@pytest.mark.parametrize("things", [(CUBE,), (ARM,), (CUBE, ARM)], ids=["a thing", "a person", "both"])
def test_a_picture_that_comes_again_and_again_is_not_believed(things):
    assert watched(*told(things, ENOUGH))[1] == 0
    watch, said = watched(*told(things, ENOUGH + 1))
    assert said == FROZEN
    (last,) = told(things, 1, ENOUGH)
    assert watch.age_conditions(last, LOOK * (ENOUGH + 0.5)) & FROZEN, "between two looks, too"


def test_it_is_over_with_the_first_picture_that_is_another_one():
    watch, _ = watched(*told((CUBE, ARM), ENOUGH + 3))
    moved = [
        msgspec.structs.replace(one, pose=Pose(tuple(np.add(one.pose.position, 1e-9).tolist()), one.pose.quaternion))
        for one in (CUBE, ARM)
    ]
    (other,) = told(moved, 1, ENOUGH + 3)
    assert watch.update(other) == 0
    assert watch.age_conditions(other, other.stamp) == 0


def test_one_person_who_is_copied_among_things_that_are_seen_is_enough():
    watch, said = SceneMonitor(), 0
    for k in range(ENOUGH + 1):
        cube = box("red_cube", 0.5 + 1e-6 * k, -0.2, error=0.009, stamp=LOOK * k)
        arm = msgspec.structs.replace(ARM, stamp=LOOK * k)
        said = watch.update(msgspec.structs.replace(scene(cube, arm), stamp=LOOK * k))
    assert said == FROZEN


def test_what_has_no_noise_or_is_not_seen_anew_may_stay_the_same():
    exact = box("post", 0.6, 0.3)
    assert watched(*told((exact,), 50))[1] == 0
    assert watched(*told((CUBE,), 50, anew=False))[1] == 0


@pytest.mark.parametrize("noise", NOISES, ids=str)
@pytest.mark.parametrize("name", ["tabletop:1", "forearm:0"])
def test_the_simulated_eyes_never_look_as_if_they_hung(noise, name):
    spec, robot_model = open_scene(name, "panda"), load_robot("panda")
    plant = make_plant(spec, robot_model, visuals=False)
    eyes, watch = NoisyPerception(spec, noise, np.random.default_rng(0)), SceneMonitor()
    for _ in range(20):
        picture = eyes.perceive(plant)
        assert not (watch.update(picture) | watch.age_conditions(picture, plant.now)) & FROZEN
        for _ in range(33):
            plant.advance()
