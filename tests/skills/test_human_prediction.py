"""Distance to a moving person, against the closest approach of two points in closed form."""

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
    """The scene with its person at `position` (2,) [m], moving with `velocity` (2,) [m/s]."""
    (person,) = [obj for obj in SCENE.objects if obj.role == "person"]
    pose = msgspec.structs.replace(person.pose, position=(*position, 0.9))
    moved = msgspec.structs.replace(person, pose=pose, velocity=(*velocity, 0.0), stamp=1.0)
    return msgspec.structs.replace(SCENE, objects=(moved,))


@given(st.tuples(near, near), st.tuples(speed, speed), st.tuples(speed, speed))
def test_the_distance_is_the_closest_approach_minus_radius_and_error(position, velocity, own_velocity):
    scene = with_person(position, velocity)
    (person,) = scene.objects
    offset, relative = np.array(position), np.array(velocity) - np.array(own_velocity)
    at = np.clip(-(offset @ relative) / (relative @ relative + 1e-30), 0.0, HORIZON - TIME_STEP)
    least = np.linalg.norm(offset + at * relative) - person.shape.radius - person.error
    found = min_person_distance(scene, lambda t: t * np.array(own_velocity), HORIZON, 1.0)
    assert least - 1e-9 <= found <= least + TIME_STEP * np.linalg.norm(relative) + 1e-9


def test_without_people_the_distance_is_infinite():
    assert (
        min_person_distance(msgspec.structs.replace(SCENE, objects=()), lambda t: np.zeros(2), HORIZON, 0.0) == np.inf
    )
