"""Averaging of objects at rest: the error bound remains valid, and the position of a moved object is taken over."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.control.scene_smoothing import MOVED_ERROR_BOUNDS, TIME_CONSTANT, SceneSmoother
from dualbrain.core.geometry.shapes import Box, Capsule, Pose
from dualbrain.records import Scene, SceneObject

BOUND = 0.009
TRUTH = np.array([0.5, -0.2, 0.025])


def measurement(stamp, position, role="object", error=BOUND, name="cube"):
    shape = Capsule(0.045, 0.25) if role == "person" else Box((0.02, 0.02, 0.025))
    obj = SceneObject(
        name=name, role=role, shape=shape, pose=Pose(tuple(float(p) for p in position)), error=error, stamp=stamp
    )
    return Scene(robot="panda", stamp=stamp, version=1, objects=(obj,))


def position_of(scene):
    return np.array(scene.objects[0].pose.position)


def sample_in_ball(rng, radius):
    direction = rng.standard_normal(3)
    return radius * rng.random() ** (1 / 3) * direction / np.linalg.norm(direction)


@given(seed=st.integers(0, 2**32 - 1), gap=st.floats(0.0, 5.0))
def test_an_average_of_measurements_within_the_bound_is_within_the_bound(seed, gap):
    rng, smoother = np.random.default_rng(seed), SceneSmoother()
    for k in range(30):
        out = position_of(smoother.update(measurement(k * gap, TRUTH + sample_in_ball(rng, BOUND))))
        assert np.linalg.norm(out - TRUTH) <= BOUND * (1 + 1e-12)


def test_a_longer_average_is_more_accurate():
    rng, smoother = np.random.default_rng(1), SceneSmoother()
    errors = [
        np.linalg.norm(position_of(smoother.update(measurement(k / 30, TRUTH + sample_in_ball(rng, BOUND)))) - TRUTH)
        for k in range(300)
    ]
    assert np.mean(errors[100:]) < 0.35 * np.mean([np.linalg.norm(sample_in_ball(rng, BOUND)) for _ in range(1000)])


@given(far=st.floats(MOVED_ERROR_BOUNDS * BOUND * 1.001 + 1e-6, 1.0), angle=st.floats(0, 6.28))
def test_the_position_of_an_object_that_moved_is_taken_over_at_once(far, angle):
    smoother = SceneSmoother()
    for k in range(60):
        smoother.update(measurement(k / 30, TRUTH))
    moved = TRUTH + far * np.array([np.cos(angle), np.sin(angle), 0.0])
    assert np.allclose(position_of(smoother.update(measurement(2.0, moved))), moved, atol=1e-12)


def displaced(smoother, by, measure, *, rest=60, after=60):
    """The distances [m] of the average from the true position after an object at rest was displaced `by` (3,) [m]."""
    for k in range(rest):
        smoother.update(measurement(k / 30, measure(TRUTH)))
    scenes = [smoother.update(measurement(k / 30, measure(TRUTH + by))) for k in range(rest, rest + after)]
    return np.array([np.linalg.norm(position_of(one) - (TRUTH + by)) for one in scenes]), scenes


@given(far=st.floats(0.0, 3.0 * BOUND), angle=st.floats(0, 6.28))
def test_the_bound_holds_in_every_scene_after_a_displacement(far, angle):
    """With exact measurements: a cube that is nudged by 17 mm is reported within 9 mm from the first scene on."""
    wrong, scenes = displaced(SceneSmoother(), far * np.array([np.cos(angle), np.sin(angle), 0.0]), lambda at: at)
    assert wrong.max() <= scenes[0].objects[0].error * (1 + 1e-9)


@given(far=st.floats(0.0, 3.0 * BOUND), seed=st.integers(0, 2**32 - 1))
def test_after_a_displacement_the_average_is_within_the_bound_of_the_newest_measurement(far, seed):
    rng, smoother = np.random.default_rng(seed), SceneSmoother()
    wrong, _ = displaced(smoother, np.array([0.0, far, 0.0]), lambda at: at + sample_in_ball(rng, BOUND), after=20)
    assert wrong.max() <= 2.0 * BOUND * (1 + 1e-9)


def test_an_object_that_creeps_is_followed_within_two_error_bounds():
    smoother = SceneSmoother()
    for k in range(300):
        at = TRUTH + np.array([0.05 * k / 30, 0.0, 0.0])
        assert (
            np.linalg.norm(position_of(smoother.update(measurement(k / 30, at))) - at)
            <= MOVED_ERROR_BOUNDS * BOUND + 1e-9
        )


def test_people_and_exact_measurements_are_not_averaged():
    for role, error in (("person", BOUND), ("object", 0.0), ("support", BOUND)):
        smoother = SceneSmoother()
        smoother.update(measurement(0.0, TRUTH, role, error))
        assert np.array_equal(position_of(smoother.update(measurement(0.1, TRUTH + 0.003, role, error))), TRUTH + 0.003)


def test_a_moving_object_is_not_averaged_and_its_average_is_reset():
    smoother = SceneSmoother()
    smoother.update(measurement(0.0, TRUTH))
    assert np.array_equal(position_of(smoother.update(measurement(0.1, TRUTH + 0.003), {"cube"})), TRUTH + 0.003)
    assert np.array_equal(position_of(smoother.update(measurement(0.2, TRUTH + 0.005))), TRUTH + 0.005)


def test_the_time_constant_is_the_stated_one():
    smoother = SceneSmoother()
    smoother.update(measurement(0.0, TRUTH))
    out = position_of(smoother.update(measurement(0.1, TRUTH + np.array([0.01, 0.0, 0.0]))))
    assert np.isclose(out[0] - TRUTH[0], 0.01 * 0.1 / TIME_CONSTANT)
