"""The experiment `speed_limits`: its judge is exact, its classes hold, and its negative controls fail."""

import numpy as np
import pytest
from scipy.optimize import differential_evolution

from dualbrain.robots.loader import load_robot
from experiments.safety.speed_limits.classes import CLASSES, COMPLETE_CLASSES, HELD, NEGATIVE_CONTROLS
from experiments.safety.speed_limits.judge import _jerk_shares
from experiments.safety.speed_limits.least_share import control_bounds, least_share
from experiments.safety.speed_limits.point_speeds import PointSpeeds
from experiments.safety.speed_limits.speed_limits import SpeedLimits, run_episode
from experiments.safety.speed_limits.trial import make_trial
from tests.safety.kernel.cartesian_speed.speed_oracle import SpeedOracle

STEPS = 2000


@pytest.mark.parametrize("robot", ["panda", "ur5e"])
def test_positions_and_speeds_are_those_of_finite_differences(robot):
    model, rng = load_robot(robot), np.random.default_rng(4)
    held = np.array(HELD)
    points, oracle = PointSpeeds(model, held), SpeedOracle(model, held[:, :3])
    q, u = rng.uniform(-2.0, 2.0, (20, model.n)), rng.uniform(-1.0, 1.0, (20, model.n))
    positions, speeds = points.measure(q, u)
    moved = [index for index, (frame, *_) in enumerate(oracle.local_points) if frame]
    for at in range(20):
        found = np.column_stack([positions[at], speeds[at]])
        expected = np.column_stack([oracle.points(q[at]), oracle.speeds(q[at], u[at])])[moved]
        order, other = (np.lexsort(np.round(one, 6).T) for one in (found, expected))
        np.testing.assert_allclose(found[order], expected[other], atol=1e-8)
    assert points.radii().shape == speeds.shape[1:]
    np.testing.assert_allclose(np.linalg.norm(points.jacobians(q[3]) @ u[3], axis=1), speeds[3], atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_the_least_share_is_that_of_a_general_solver(seed):
    rng = np.random.default_rng(seed)
    jacobians, limits = rng.standard_normal((12, 3, 4)), rng.uniform(0.5, 2.0, 12)
    lower = rng.uniform(-1.0, 1.0, 4)
    upper = lower + rng.uniform(0.1, 1.0, 4)

    def share(u):
        return float((np.linalg.norm(jacobians @ u, axis=1) / limits).max())

    box = [*zip(lower, upper, strict=True)]
    other = differential_evolution(share, box, seed=1, tol=1e-10, atol=1e-10, maxiter=2000, polish=False)
    assert other.success
    assert least_share(jacobians, limits, (lower, upper)) == pytest.approx(other.fun, abs=1e-4)


def test_the_bounds_of_a_control_follow_from_speed_acceleration_and_jerk():
    model = load_robot("panda")
    before, change = np.full(model.n, 0.1), np.full(model.n, 1e-3)
    lower, upper = control_bounds(model, before, change, limits_jerk=False)
    steps = [joint.acceleration.value * model.period for joint in model.joints]
    np.testing.assert_allclose(upper - lower, np.multiply(2.0, steps))
    narrow = control_bounds(model, before, change, limits_jerk=True)
    assert np.all(narrow[0] >= lower)
    assert np.all(narrow[1] <= upper)
    jumps = [joint.jerk.value * model.period**2 for joint in model.joints]
    np.testing.assert_array_less(narrow[1] - narrow[0], np.multiply(2.0, jumps) + 1e-12)


def test_the_jerk_of_a_step_from_rest_is_measured():
    model = load_robot("panda")
    jerk = np.array([joint.jerk.value for joint in model.joints])
    u = np.zeros((5, model.n))
    u[2:, 3] = 0.5 * jerk[3] * model.period**2
    np.testing.assert_allclose(_jerk_shares(model, u), [0.0, 0.0, 0.5, 0.5, 0.0], atol=1e-9)


@pytest.mark.parametrize("kind", COMPLETE_CLASSES, ids=lambda kind: kind.name)
def test_no_step_of_a_class_is_above_its_limits(kind):
    row = run_episode(kind, 3, STEPS)
    assert (row["above"], row["jerks"]) == (0, 0)
    assert row["used"] > 0, "the limit is reached"
    assert not kind.near or row["near"] > 0
    assert sum(row[name] for name in ("safe", "modified", "relaxed", "stopped", "fault")) == STEPS


@pytest.mark.parametrize("kind", NEGATIVE_CONTROLS, ids=lambda kind: kind.name)
def test_a_negative_control_exceeds_the_limit_that_it_has_lost(kind):
    row = run_episode(kind, 3, STEPS)
    assert row["jerks" if kind.judges_jerk else "above"] > 50


@pytest.mark.parametrize(
    ("name", "seed", "step"), [("person", 14, 4536), ("jerk", 75, 4674), ("person, UR5e", 104, 7560)]
)
def test_a_step_above_the_limit_is_one_that_the_filter_reports(name, seed, step):
    """Steps that the adversary found; the filter does not report a step of the same loop long before."""
    trial = make_trial(CLASSES[name], seed)
    assert trial.reports_overspeed(step)
    assert not trial.reports_overspeed(1000)


def test_the_report_counts_steps_and_controls():
    experiment = SpeedLimits()
    rows = [{"class": name, **run_episode(CLASSES[name], 0, 500)} for name in ("limit", "no limit")]
    text = "\n".join(experiment.report(rows))
    assert "**500** steps: a part above its limit on 0 (0.0e+00), on **0** of them without a report" in text
    assert "fails, as expected" in text
    assert sum(unit.parameters["class"] == "limit" for unit in experiment.units(None)) * 100_000 * 10 >= 1e7
