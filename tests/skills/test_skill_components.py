"""Components of skills: via points, progress watchdog, predicted contact with people."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.core.geometry.rotations import matrix_to_quaternion
from dualbrain.core.geometry.shapes import Capsule, Pose
from dualbrain.records import Scene, SceneObject
from dualbrain.skills.arm.waypoints import NEAR_BASE_RADIUS, VIA_POINT_RADIUS_RANGE, via_point
from dualbrain.skills.human_prediction import person_may_reach
from dualbrain.skills.progress_watchdog import PROGRESS_TIMEOUT, ProgressWatchdog

START, END = np.array([0.5, -0.22, 0.2]), np.array([0.5, 0.26, 0.2])


def test_via_points_are_on_the_side_of_their_name():
    assert via_point(START, END, "direct") is None
    near, left, right = (via_point(START, END, name) for name in ("near_base", "left", "right"))
    assert np.isclose(np.linalg.norm(near[:2]), NEAR_BASE_RADIUS)
    assert left[0] < START[0] < right[0]  # travelling towards +y, left is towards -x
    for via in (left, right):
        assert VIA_POINT_RADIUS_RANGE[0] - 1e-9 <= np.linalg.norm(via[:2]) <= VIA_POINT_RADIUS_RANGE[1] + 1e-9


def test_the_watchdog_ends_a_motion_without_progress():
    watchdog = ProgressWatchdog(0.0, time_limit=100.0)
    assert watchdog.update(0.1, 1.0) is None
    assert watchdog.update(0.1 + PROGRESS_TIMEOUT, 0.9) is None
    assert watchdog.update(0.2 + 2 * PROGRESS_TIMEOUT, 0.8999) is not None


def test_the_watchdog_ends_a_moving_robot_at_its_time_limit():
    watchdog = ProgressWatchdog(0.0, time_limit=2.0)
    assert all(watchdog.update(t, 10.0 - t) is None for t in np.arange(0.0, 2.0, 0.1))
    assert watchdog.update(2.1, 1.0) == "out of time"


def person(y: float, vy: float, stamp: float = 0.0) -> Scene:
    along_x = matrix_to_quaternion(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]))
    arm = SceneObject(
        name="forearm",
        role="person",
        shape=Capsule(0.045, 0.25),
        pose=Pose((0.5, y, 0.2), along_x),
        velocity=(0.0, vy, 0.0),
        stamp=stamp,
    )
    return Scene(robot="panda", stamp=stamp, version=1, objects=(arm,))


def test_an_approaching_person_may_reach_the_spot_and_a_leaving_one_may_not():
    spot = np.array([0.5, 0.0, 0.05])
    assert person_may_reach(person(0.6, -0.2), spot, 3.0, 0.2, 0.0)
    assert not person_may_reach(person(0.6, 0.2), spot, 3.0, 0.2, 0.0)
    assert not person_may_reach(person(0.6, 0.0), spot, 3.0, 0.2, 0.0)
    assert person_may_reach(person(0.1, 0.0), spot, 3.0, 0.2, 0.0)


def test_an_old_observation_is_extrapolated_to_the_present():
    spot = np.array([0.5, 0.0, 0.05])
    assert not person_may_reach(person(0.6, -0.2), spot, 0.1, 0.2, 0.0)
    assert person_may_reach(person(0.6, -0.2), spot, 0.1, 0.2, 2.5)


POSITIONS = st.tuples(st.floats(-1, 1), st.floats(-1, 1))
VELOCITIES = st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
TURNS = st.floats(-3, 3)


def passing_person(velocity, turn=0.0) -> Scene:
    """A forearm over (0.5, 0) at angle `turn` [rad] to the x axis that moves with `velocity` (2,) [m/s]."""
    pointing = np.array([np.cos(turn), np.sin(turn), 0.0])
    across = np.array([-pointing[1], pointing[0], 0.0])
    rotation = np.column_stack([across, np.cross(pointing, across), pointing])
    arm = SceneObject(
        name="forearm",
        role="person",
        shape=Capsule(0.045, 0.25),
        pose=Pose((0.5, 0.0, 0.2), matrix_to_quaternion(rotation)),
        velocity=(*velocity, 0.0),
    )
    return Scene(robot="panda", stamp=0.0, version=1, objects=(arm,))


@given(
    position=POSITIONS,
    velocity=VELOCITIES,
    turn=TURNS,
    horizon=st.floats(0.1, 4.0),
    more=st.floats(0.0, 2.0),
)
def test_a_longer_horizon_never_misses_a_person(position, velocity, turn, horizon, more):
    spot, scene = np.array([*position, 0.05]), passing_person(velocity, turn)
    if person_may_reach(scene, spot, horizon, 0.2, 0.0):
        assert person_may_reach(scene, spot, horizon + more, 0.2 + 1e-9, 0.0)


@given(position=POSITIONS, velocity=VELOCITIES, turn=TURNS, horizon=st.floats(0.1, 4.0))
def test_the_swept_region_contains_the_axis_at_all_times(position, velocity, turn, horizon):
    spot, scene, reach = np.array([*position, 0.05]), passing_person(velocity, turn), 0.2
    times, shares = np.meshgrid(np.linspace(0.0, horizon, 201), np.linspace(-1.0, 1.0, 101))
    axis = np.array([0.5, 0.0]) + times[..., None] * velocity + 0.25 * shares[..., None] * [np.cos(turn), np.sin(turn)]
    least = float(np.linalg.norm(axis - position, axis=-1).min()) - 0.045  # at most 0.01 above the distance
    if least < reach:
        assert person_may_reach(scene, spot, horizon, reach + 1e-9, 0.0)
    elif least > reach + 0.01:
        assert not person_may_reach(scene, spot, horizon, reach, 0.0)
