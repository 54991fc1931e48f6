"""Room that two who move leave each other, against the closest approach of two points in closed form."""

import msgspec
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.records import Scene
from dualbrain.skills.human_prediction import TIME_STEP, min_person_distance
from tests.simulation.mobile_base_cell import MobileBaseCell

SCENE = MobileBaseCell("crossing", 2).executor.scene
HORIZON = 6.0
near = st.floats(-2.0, 2.0)
speed = st.floats(-0.5, 0.5)


def with_person(position, velocity) -> Scene:
    """The scene with its person at `position` (2,) [m], going at `velocity` (2,) [m/s] since now."""
    (person,) = [thing for thing in SCENE.objects if thing.role == "person"]
    pose = msgspec.structs.replace(person.pose, position=(*position, 0.9))
    moved = msgspec.structs.replace(person, pose=pose, velocity=(*velocity, 0.0), stamp=1.0)
    return msgspec.structs.replace(SCENE, objects=(moved,))


@given(st.tuples(near, near), st.tuples(speed, speed), st.tuples(speed, speed))
def test_it_is_the_closest_approach_less_the_persons_radius_and_error(position, velocity, pace):
    scene = with_person(position, velocity)
    (person,) = scene.objects
    away, drift = np.array(position), np.array(velocity) - np.array(pace)
    at = np.clip(-(away @ drift) / (drift @ drift + 1e-30), 0.0, HORIZON - TIME_STEP)
    least = np.linalg.norm(away + at * drift) - person.shape.radius - person.error
    found = min_person_distance(scene, lambda t: t * np.array(pace), HORIZON, 1.0)
    assert least - 1e-9 <= found <= least + TIME_STEP * np.linalg.norm(drift) + 1e-9


def test_alone_there_is_all_the_room():
    assert (
        min_person_distance(msgspec.structs.replace(SCENE, objects=()), lambda t: np.zeros(2), HORIZON, 0.0) == np.inf
    )
