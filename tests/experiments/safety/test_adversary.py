"""The reference distances agree with the tests' oracle; short runs of each class hold, each negative control fails."""

import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace, Pose, Sphere
from dualbrain.safety.cbf.filter import Obstacle
from experiments.safety import random_scenes
from experiments.safety.adversary.classes import (
    CLASSES,
    LAG,
    MOVING_CLASSES,
    NEGATIVE_CONTROLS,
    STATIC_CLASSES,
    UNDISTURBED,
)
from experiments.safety.adversary.forward_invariance import aggregate, load_panda, run_episode, run_trial
from experiments.safety.adversary.tables import adversary_tables, count_violations
from experiments.safety.reference_judge import rotation_matrix, true_h
from tests.safety import geometry_oracle

OBSTACLES = (
    Obstacle("table", HalfSpace(), Pose((0.0, 0.0, 0.02), (0.96, 0.28, 0.0, 0.0))),
    Obstacle("sphere", Sphere(0.07), Pose((0.5, 0.1, 0.5))),
    Obstacle("rod", Capsule(0.04, 0.2), Pose((0.3, -0.4, 0.6), (0.5, 0.5, -0.5, 0.5))),
    Obstacle("crate", Box((0.1, 0.2, 0.05)), Pose((-0.4, 0.3, 0.5), (0.6, 0.0, 0.8, 0.0))),
)


def postures(count, seed=0):
    robot_model, _ = load_panda()
    rng = np.random.default_rng(seed)
    bounds = [[getattr(joint, side).value for joint in robot_model.joints] for side in ("lower", "upper")]
    return robot_model, rng.uniform(*bounds, (count, robot_model.n))


def test_the_reference_distances_equal_the_oracle():
    """Single postures, with and without contact: obstacles, own links, joint limits."""
    robot_model, q = postures(60)
    _, judge = load_panda()
    distances = np.vstack([true_h(judge, one[None], OBSTACLES) for one in q])
    assert distances[:, 0] == pytest.approx(geometry_oracle.h_obstacles(robot_model, q, OBSTACLES), abs=1e-12)
    assert distances[:, 2] == pytest.approx(geometry_oracle.h_self(robot_model, q), abs=1e-12)
    assert distances[:, 3] == pytest.approx(geometry_oracle.h_joints(robot_model, q), abs=1e-12)
    assert distances[:, 0].min() < -0.05 < 0.05 < distances[:, 0].max()


def test_along_a_path_no_small_distance_is_missed():
    """A distance that is not measured again is at least 2 cm."""
    robot_model, ends = postures(2, seed=4)
    _, judge = load_panda()
    q = ends[0] + np.linspace(0.0, 1.0, 700)[:, None] * (ends[1] - ends[0])
    distances = true_h(judge, q, OBSTACLES)[1:]
    assert distances[:, 0] == pytest.approx(
        np.minimum(geometry_oracle.h_obstacles(robot_model, q, OBSTACLES), 0.02)[1:], abs=1e-12
    )
    assert distances[:, 2] == pytest.approx(np.minimum(geometry_oracle.h_self(robot_model, q), 0.02)[1:], abs=1e-12)
    assert np.any(distances[:, 0] < 0.02)


def test_the_approach_is_the_speed_of_the_touching_sphere():
    """Joint 1 turns the arm into a wall at rest: the approach is ω times the lever arm of the deepest sphere."""
    robot_model, judge = load_panda()
    q = np.tile(np.array(robot_model.home), (2, 1))
    q[1, 0] += 1e-3
    tip = geometry_oracle.sphere_centres(robot_model, q)[0][:, :, :]
    ahead = tip[1, :, 1].max() + 0.05
    wall = Obstacle("wall", HalfSpace(), Pose((0.0, ahead - 0.1, 0.0), (0.5**0.5, 0.5**0.5, 0.0, 0.0)), static=False)
    distances = true_h(judge, q, [wall])[1]
    moving = [i for i, name in enumerate(geometry_oracle.sphere_centres(robot_model, q)[2]) if name != "link0"]
    radii = geometry_oracle.sphere_centres(robot_model, q)[1]
    deep = [i for i in moving if ahead - 0.1 - tip[1, i, 1] < radii[i]]
    assert distances[1] < 0.0
    assert distances[4] == pytest.approx(max((tip[1, i, 1] - tip[0, i, 1]) / 1e-3 for i in deep), rel=1e-5)


def test_the_rotation_matrix_equals_scipys():
    q = np.random.default_rng(1).normal(size=4)
    q /= np.linalg.norm(q)
    assert rotation_matrix(q) == pytest.approx(geometry_oracle.rotation_matrix(q))


def test_the_recorded_minima_equal_the_oracle():
    counts, path, truth = run_trial(CLASSES["drops"], 3, 600, log=True)
    robot_model, _ = load_panda()
    h = geometry_oracle.h_obstacles(robot_model, path, truth)
    assert counts["h_still"] == pytest.approx(min(h.min(), 0.02), abs=1e-12)
    assert counts["h_self"] == pytest.approx(min(geometry_oracle.h_self(robot_model, path).min(), 0.02), abs=1e-12)
    assert counts["steps"] == 600


@pytest.mark.parametrize("kind", STATIC_CLASSES, ids=lambda kind: kind.name)
def test_static_classes_hold(kind):
    counts = aggregate([run_episode(kind, seed, 2500) for seed in (1, 2)])
    assert sum(counts["still"]) == 0
    assert counts["status"][3] <= 1e-3 * counts["steps"]
    assert counts["jerks"] == 0


@pytest.mark.parametrize("kind", MOVING_CLASSES, ids=lambda kind: kind.name)
def test_every_step_of_a_moving_class_is_counted(kind):
    counts = aggregate([run_episode(kind, seed, 2000) for seed in (1, 2)])
    assert sum(counts["attacked"]) == counts["steps"]
    assert counts["plans"][1] if kind.name == "evadable" else counts["plans"][0]


@pytest.mark.parametrize(("kind", "seeds", "steps"), [(NEGATIVE_CONTROLS[0], (0, 1), 3000)])
def test_static_negative_controls_fail(kind, seeds, steps):
    assert count_violations(aggregate([run_episode(kind, seed, steps) for seed in seeds])) > 0


def test_a_gain_above_that_of_braking_is_covered_by_the_distance_of_a_stop():
    """Without that distance, the arm entered an obstacle with this seed by the 1000th step."""
    assert CLASSES["alpha 10"].is_covered
    assert count_violations(run_episode(CLASSES["alpha 10"], 9, 1000)) == 0


@pytest.mark.slow
@pytest.mark.parametrize("kind", NEGATIVE_CONTROLS, ids=lambda kind: kind.name)
def test_every_negative_control_fails_unless_it_is_covered(kind):
    assert (count_violations(aggregate([run_episode(kind, seed) for seed in range(20)])) == 0) == kind.is_covered


def test_a_run_repeats_from_its_seed():
    assert run_episode(CLASSES["late"], 5, 500) == run_episode(CLASSES["late"], 5, 500)


def test_the_filter_assumes_at_least_the_errors_of_the_loop():
    for kind in (*STATIC_CLASSES, *MOVING_CLASSES):
        loop = {**UNDISTURBED, **kind.loop_settings}
        if loop["push"] > 0.0:
            assert kind.filter_config().tracking_error >= loop["push"] + 3.4 * (loop["q_noise"] + LAG * loop["v_noise"])
        assert kind.margin >= loop["place_noise"]
    obstacle = CLASSES["person"].perceived_obstacle(msgspec.structs.replace(OBSTACLES[1], static=False))
    assert obstacle.velocity_error == CLASSES["person"].loop_settings["mover_speed"]


def test_random_obstacles_keep_their_distance():
    robot_model, judge = load_panda()
    rng = np.random.default_rng(2)
    q = random_scenes.random_posture(robot_model, judge, rng)
    found = random_scenes.random_obstacles(judge, q, rng, 5)
    assert geometry_oracle.h_obstacles(robot_model, q[None], found)[0] > 0.05
    assert true_h(judge, q[None], [random_scenes.random_moving_obstacle(judge, q, rng)])[0, 1] > 0.25


def test_tables_name_every_class():
    totals = {name: aggregate([run_episode(CLASSES[name], 1, 200)]) for name in CLASSES}
    text = "\n".join(adversary_tables(totals))
    assert all(f"| {name} |" in text for name in CLASSES)
    assert "on **0** steps" in text
