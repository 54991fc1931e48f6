"""The small parts of skills: bends, progress, people."""

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


def test_bends_pass_where_their_names_say():
    assert via_point(START, END, "direct") is None
    near, left, right = (via_point(START, END, name) for name in ("near_base", "left", "right"))
    assert np.isclose(np.linalg.norm(near[:2]), NEAR_BASE_RADIUS)
    assert left[0] < START[0] < right[0]  # travelling towards +y, left is towards -x
    for via in (left, right):
        assert VIA_POINT_RADIUS_RANGE[0] - 1e-9 <= np.linalg.norm(via[:2]) <= VIA_POINT_RADIUS_RANGE[1] + 1e-9


def test_progress_is_patient_only_for_so_long():
    watch = ProgressWatchdog(0.0, time_limit=100.0)
    assert watch.update(0.1, 1.0) is None
    assert watch.update(0.1 + PROGRESS_TIMEOUT, 0.9) is None
    assert watch.update(0.2 + 2 * PROGRESS_TIMEOUT, 0.8999) is not None


def test_progress_ends_at_the_time_limit_even_while_moving():
    watch = ProgressWatchdog(0.0, time_limit=2.0)
    assert all(watch.update(t, 10.0 - t) is None for t in np.arange(0.0, 2.0, 0.1))
    assert watch.update(2.1, 1.0) == "out of time"


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


def test_a_person_who_comes_is_waited_for_and_one_who_leaves_is_not():
    spot = np.array([0.5, 0.0, 0.05])
    assert person_may_reach(person(0.6, -0.2), spot, 3.0, 0.2, 0.0)
    assert not person_may_reach(person(0.6, 0.2), spot, 3.0, 0.2, 0.0)
    assert not person_may_reach(person(0.6, 0.0), spot, 3.0, 0.2, 0.0)
    assert person_may_reach(person(0.1, 0.0), spot, 3.0, 0.2, 0.0)


def test_an_old_sighting_is_carried_forward():
    spot = np.array([0.5, 0.0, 0.05])
    assert not person_may_reach(person(0.6, -0.2), spot, 0.1, 0.2, 0.0)
    assert person_may_reach(person(0.6, -0.2), spot, 0.1, 0.2, 2.5)


PLACES, PACES = st.tuples(st.floats(-1, 1), st.floats(-1, 1)), st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))


def passer_by(velocity, turn=0.0) -> Scene:
    """A forearm over (0.5, 0), pointing by `turn` [rad] from the x axis, that moves with `velocity` (2,)."""
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


@given(place=PLACES, pace=PACES, turn=st.floats(-3, 3), horizon=st.floats(0.1, 4.0), more=st.floats(0.0, 2.0))
def test_a_longer_horizon_never_sees_less(place, pace, turn, horizon, more):
    spot, scene = np.array([*place, 0.05]), passer_by(pace, turn)
    if person_may_reach(scene, spot, horizon, 0.2, 0.0):
        assert person_may_reach(scene, spot, horizon + more, 0.2 + 1e-9, 0.0)


@given(place=PLACES, pace=PACES, turn=st.floats(-3, 3), horizon=st.floats(0.1, 4.0))
def test_a_sweep_is_what_the_axis_passes_by(place, pace, turn, horizon):
    spot, scene, reach = np.array([*place, 0.05]), passer_by(pace, turn), 0.2
    times, shares = np.meshgrid(np.linspace(0.0, horizon, 201), np.linspace(-1.0, 1.0, 101))
    axis = np.array([0.5, 0.0]) + times[..., None] * pace + 0.25 * shares[..., None] * [np.cos(turn), np.sin(turn)]
    least = float(np.linalg.norm(axis - place, axis=-1).min()) - 0.045  # no nearer than the truth, and hardly farther
    if least < reach:
        assert person_may_reach(scene, spot, horizon, reach + 1e-9, 0.0)
    elif least > reach + 0.01:
        assert not person_may_reach(scene, spot, horizon, reach, 0.0)
