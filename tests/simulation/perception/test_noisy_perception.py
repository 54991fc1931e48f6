"""Noisy perception: the declared bounds always hold, the generator makes it reproducible, stamps show the age."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.core.geometry.shapes import HalfSpace
from dualbrain.errors import ConfigurationError
from dualbrain.simulation.perception.noisy_perception import NO_NOISE, NoisyPerception, PerceptionNoise
from tests.simulation.scripted_hand import make_plant, wait

SCENE = make_plant("forearm", 1)


def observe(noise, seed=0, count=1, p=SCENE):
    perception = NoisyPerception(p.spec, noise, np.random.default_rng(seed))
    return [perception.perceive(p) for _ in range(count)]


def error(p, obj):
    return np.subtract(obj.pose.position, p.true_pose(obj.name).position)


@given(st.floats(1e-4, 0.02), st.floats(0.0, 2.0), st.integers(0, 999))
@settings(max_examples=40, deadline=None)
def test_the_norm_of_the_error_never_exceeds_the_declared_bound(sigma, correlation_time, seed):
    for scene in observe(PerceptionNoise(sigma=sigma, correlation_time=correlation_time), seed, count=10):
        for obj in scene.objects[1:]:
            assert np.linalg.norm(error(SCENE, obj)) <= obj.error + 1e-12
            assert obj.error == pytest.approx(3 * sigma)


def test_errors_have_the_declared_spread():
    p = make_plant("bare", 0)
    errors = [
        error(p, scene.find("red_cube")) for scene in observe(PerceptionNoise(correlation_time=0.0), count=2000, p=p)
    ]
    assert np.std(errors) == pytest.approx(0.003, rel=0.08)
    assert np.abs(np.mean(errors, axis=0)).max() < 4e-4


def test_errors_drift_slowly():
    p = make_plant("bare", 0)
    perception = NoisyPerception(p.spec, PerceptionNoise(correlation_time=0.5), np.random.default_rng(1))
    errors = []
    for _ in range(60):
        wait(p, 0.033)
        errors.append(error(p, perception.perceive(p).find("red_cube")))
    steps = np.linalg.norm(np.diff(errors, axis=0), axis=1)
    assert 0.0 < np.median(steps) < 0.003
    assert np.ptp(errors, axis=0).max() > 0.003


def test_without_noise_perception_equals_the_ground_truth():
    scene = observe(NO_NOISE)[0]
    for obj in scene.objects[1:]:
        assert np.allclose(error(SCENE, obj), 0.0)
        assert obj.error == 0.0


def test_the_same_generator_gives_the_same_scene():
    assert observe(PerceptionNoise(), 5, 3) == observe(PerceptionNoise(), 5, 3)
    assert observe(PerceptionNoise(), 5) != observe(PerceptionNoise(), 6)


def test_roles_and_the_table():
    scene = observe(PerceptionNoise())[0]
    roles = {obj.name: obj.role for obj in scene.objects}
    assert roles["red_cube"] == "object"
    assert roles["blue_bowl"] == "container"
    assert roles["forearm"] == "person"
    assert scene.find("table").role == "support"
    assert scene.find("table").shape == HalfSpace()
    assert scene.find("table").error == 0.0
    assert "red_cube" in scene.graspable
    assert {"blue_bowl", "table_left"} <= set(scene.receptive)


def test_a_persons_velocity_is_within_its_bound():
    p = make_plant("forearm", 1)
    perception = NoisyPerception(p.spec, PerceptionNoise(velocity_error=0.05), np.random.default_rng(0))
    speeds = []
    for _ in range(40):
        wait(p, 0.1)
        arm = perception.perceive(p).find("forearm")
        assert np.linalg.norm(np.subtract(arm.velocity, p.object_velocity("forearm"))) <= arm.velocity_error
        speeds.append(np.linalg.norm(p.object_velocity("forearm")))
    assert max(speeds) > 0.1


def test_latency_returns_an_earlier_observation_with_its_stamp():
    p = make_plant("forearm", 1)
    perception = NoisyPerception(
        p.spec, PerceptionNoise(sigma=0.0, velocity_error=0.0, latency=0.1), np.random.default_rng(0)
    )
    history = {}
    for _ in range(60):
        history[round(p.now, 3)] = p.true_pose("forearm").position
        arm = perception.perceive(p).find("forearm")
        assert arm.pose.position == history[round(arm.stamp, 3)]
        wait(p, 0.02)
    assert p.now - 0.02 - arm.stamp == pytest.approx(0.1, abs=0.021)


def test_missed_objects_keep_the_old_stamp():
    p = make_plant("bare", 0)
    perception = NoisyPerception(p.spec, PerceptionNoise(dropout_probability=0.5), np.random.default_rng(0))
    ages = []
    for _ in range(60):
        wait(p, 0.01)
        scene = perception.perceive(p)
        ages += [scene.stamp - obj.stamp for obj in scene.objects[1:]]
    assert max(ages) > 0.02
    assert min(ages) == 0.0


def test_hidden_objects_are_absent_and_the_version_counts_changes_of_names():
    scenes = observe(PerceptionNoise(hidden_objects=frozenset({"forearm"})), count=3)
    assert all(obj.name != "forearm" for scene in scenes for obj in scene.objects)
    assert [scene.version for scene in scenes] == [1, 1, 1]


def test_invalid_noise_is_rejected():
    with pytest.raises(ConfigurationError, match="dropout_probability below 1"):
        observe(PerceptionNoise(dropout_probability=1.0))


@pytest.mark.parametrize("name", ["sigma", "correlation_time", "velocity_error", "latency", "dropout_probability"])
@pytest.mark.parametrize("value", [-0.001, float("nan")])
def test_noise_that_is_negative_or_no_number_is_rejected(name, value):
    with pytest.raises(ConfigurationError, match="perception noise"):
        observe(PerceptionNoise(**{name: value}))


@pytest.mark.parametrize("name", ["sigma", "velocity_error", "latency"])
def test_infinite_noise_is_rejected(name):
    with pytest.raises(ConfigurationError, match="perception noise"):
        observe(PerceptionNoise(**{name: float("inf")}))
