"""Averaging of things at rest: the error bound survives it, and what has moved is believed."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.control.scene_smoothing import MOVED_ERROR_BOUNDS, TIME_CONSTANT, SceneSmoother
from dualbrain.core.geometry.shapes import Box, Capsule, Pose
from dualbrain.records import Scene, SceneObject

BOUND = 0.009
TRUTH = np.array([0.5, -0.2, 0.025])


def sighting(stamp, position, role="object", error=BOUND, name="cube"):
    shape = Capsule(0.045, 0.25) if role == "person" else Box((0.02, 0.02, 0.025))
    thing = SceneObject(
        name=name, role=role, shape=shape, pose=Pose(tuple(float(p) for p in position)), error=error, stamp=stamp
    )
    return Scene(robot="panda", stamp=stamp, version=1, objects=(thing,))


def seen(scene):
    return np.array(scene.objects[0].pose.position)


def in_ball(rng, radius):
    direction = rng.standard_normal(3)
    return radius * rng.random() ** (1 / 3) * direction / np.linalg.norm(direction)


@given(seed=st.integers(0, 2**32 - 1), gap=st.floats(0.0, 5.0))
def test_an_average_of_sightings_within_the_bound_lies_within_the_bound(seed, gap):
    rng, steady = np.random.default_rng(seed), SceneSmoother()
    for k in range(30):
        out = seen(steady.update(sighting(k * gap, TRUTH + in_ball(rng, BOUND))))
        assert np.linalg.norm(out - TRUTH) <= BOUND * (1 + 1e-12)


def test_looking_longer_sees_better():
    rng, steady = np.random.default_rng(1), SceneSmoother()
    errors = [
        np.linalg.norm(seen(steady.update(sighting(k / 30, TRUTH + in_ball(rng, BOUND)))) - TRUTH) for k in range(300)
    ]
    assert np.mean(errors[100:]) < 0.35 * np.mean([np.linalg.norm(in_ball(rng, BOUND)) for _ in range(1000)])


@given(far=st.floats(MOVED_ERROR_BOUNDS * BOUND * 1.001 + 1e-6, 1.0), angle=st.floats(0, 6.28))
def test_a_thing_that_moved_is_believed_at_once(far, angle):
    steady = SceneSmoother()
    for k in range(60):
        steady.update(sighting(k / 30, TRUTH))
    moved = TRUTH + far * np.array([np.cos(angle), np.sin(angle), 0.0])
    assert np.allclose(seen(steady.update(sighting(2.0, moved))), moved, atol=1e-12)


def test_a_thing_that_creeps_is_followed_within_two_bounds():
    steady = SceneSmoother()
    for k in range(300):
        at = TRUTH + np.array([0.05 * k / 30, 0.0, 0.0])
        assert np.linalg.norm(seen(steady.update(sighting(k / 30, at))) - at) <= MOVED_ERROR_BOUNDS * BOUND + 1e-9


def test_people_and_exact_sightings_are_taken_as_they_are():
    for role, error in (("person", BOUND), ("object", 0.0), ("support", BOUND)):
        steady = SceneSmoother()
        steady.update(sighting(0.0, TRUTH, role, error))
        assert np.array_equal(seen(steady.update(sighting(0.1, TRUTH + 0.003, role, error))), TRUTH + 0.003)


def test_what_is_in_the_hand_is_taken_as_seen_and_forgotten():
    steady = SceneSmoother()
    steady.update(sighting(0.0, TRUTH))
    assert np.array_equal(seen(steady.update(sighting(0.1, TRUTH + 0.003), {"cube"})), TRUTH + 0.003)
    assert np.array_equal(seen(steady.update(sighting(0.2, TRUTH + 0.005))), TRUTH + 0.005)


def test_the_time_constant_is_the_stated_one():
    steady = SceneSmoother()
    steady.update(sighting(0.0, TRUTH))
    out = seen(steady.update(sighting(0.1, TRUTH + np.array([0.01, 0.0, 0.0]))))
    assert np.isclose(out[0] - TRUTH[0], 0.01 * 0.1 / TIME_CONSTANT)
