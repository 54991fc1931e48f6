"""The tracking model: a known lag is recovered, and the leaky integral bounds the decrease of a barrier."""

from math import inf, nan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.errors import ConfigurationError
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import TrackingErrorModel
from dualbrain.simulation.identification.excitation import EXCITATION_KINDS, ExcitationLog, excite
from dualbrain.simulation.identification.tracking_model import (
    SAFETY_FACTOR,
    fit_tracking_model,
    identify_plant,
    leaky_error,
)

PANDA = load_robot("panda")
PERIOD, RATE = 1e-3, 3.45


class FirstOrder:
    """A plant with a known lag and a known residual r: y = q + lag v obeys ẏ = u + r exactly."""

    def __init__(self, n, lag, residual=lambda t: 0.0):
        self.q, self.v, self.lag, self.residual, self.t = (
            np.array(load_robot("panda").home),
            np.zeros(n),
            lag,
            residual,
            0,
        )

    def measure(self):
        """The state is always current."""

    def apply(self, u):
        u = u + self.residual(self.t * PERIOD)
        fade = np.exp(-PERIOD / self.lag)
        self.q = self.q + u * PERIOD + (self.v - u) * self.lag * (1.0 - fade)
        self.v = u + (self.v - u) * fade
        self.t += 1


def excitation_log(plant, u):
    """The log of `plant` under given controls (n_periods, n)."""
    q, v = np.empty_like(u), np.empty_like(u)
    for t, control in enumerate(u):
        q[t], v[t] = plant.q, plant.v
        plant.apply(control)
    return ExcitationLog(q, v, u)


def random_controls(seed, steps=3000, n=7):
    rng = np.random.default_rng(seed)
    t = np.arange(steps)[:, None] * PERIOD
    return 2.0 * np.sin(rng.uniform(1.0, 9.0, n) * t + rng.uniform(0.0, 6.0, n))


@settings(max_examples=10, deadline=None)
@given(st.floats(0.0005, 0.03), st.integers(0, 10**6))
def test_a_known_lag_is_recovered(lag, seed):
    found = fit_tracking_model([[excitation_log(FirstOrder(7, lag), random_controls(seed))]], RATE, PERIOD)
    assert found.lag == pytest.approx(lag, abs=3e-6)
    assert found.position_error < 1e-4


def test_a_constant_residual_gives_r_over_alpha():
    """∫ exp(−α s) r ds converges to r/α; the residual acts on u only, so that it does not change the lag."""
    plant = FirstOrder(7, 0.004, lambda t: 0.02)
    found = fit_tracking_model([[excitation_log(plant, random_controls(3, 4000))]], RATE, PERIOD, lag=0.004)
    assert found.position_error == pytest.approx(SAFETY_FACTOR * 0.02 / RATE, rel=0.01)
    assert found.tracking_error == pytest.approx([SAFETY_FACTOR * 0.02] * 7, rel=0.01)
    assert found.velocity_error == pytest.approx(0.02, rel=1e-3)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from((0.05, 0.3, 3.0)))
def test_the_leaky_integral_bounds_the_decrease_of_a_barrier(seed, frequency):
    """For a wall in front of two joints and u = −α h at the measured y, h never falls below −Σ |a_k| e_k."""
    rng = np.random.default_rng(seed)
    a, amplitude, phase = rng.uniform(-1.0, 1.0, 2), rng.uniform(0.0, 0.1, 2), rng.uniform(0.0, 6.0, 2)
    plant = FirstOrder(2, 0.003, lambda t: amplitude * np.sign(np.sin(2.0 * np.pi * frequency * t + phase)))
    plant.q, steps = np.zeros(2), 2500
    q, v, u, h = np.empty((steps, 2)), np.empty((steps, 2)), np.empty((steps, 2)), np.empty(steps)
    for t in range(steps):
        y = plant.q + plant.lag * plant.v
        q[t], v[t], h[t] = plant.q, plant.v, 0.05 + a @ y
        u[t] = -RATE * h[t] * a / (a @ a)
        plant.apply(u[t])
    e = leaky_error(ExcitationLog(q, v, u), plant.lag, RATE, PERIOD)
    assert np.all(h[1:] >= -np.abs(e) @ np.abs(a) - 1e-4)
    model = 0.05 * np.exp(-RATE * PERIOD * np.arange(1, steps))
    assert np.allclose(h[1:], model + e @ a, atol=2e-4)


def test_row_term_inflates_the_barrier_by_the_error():
    """With tracking = α e in the row, the worst residual within the bound leaves h at zero or above."""
    e = 0.005
    h = 0.04
    for _ in range(8000):
        u = -RATE * h + RATE * e
        h += PERIOD * (u - RATE * e)
        assert h >= 0.0


def test_the_error_covers_two_standard_deviations_over_seeds():
    logs = [
        [excitation_log(FirstOrder(7, 0.002, lambda t, r=r: r), random_controls(i))] for i, r in enumerate((0.01, 0.02))
    ]
    found = fit_tracking_model(logs, RATE, PERIOD, lag=0.002)
    spread = np.mean(found.by_seed) + 2.0 * np.std(found.by_seed, ddof=1)
    assert found.position_error == pytest.approx(SAFETY_FACTOR * max(*found.by_seed, spread))
    assert np.all(np.array(found.position_errors) >= SAFETY_FACTOR * np.array(found.largest))


def test_every_joint_has_its_own_error():
    residual = np.array([0.0, 0.03, 0.01, 0.0, 0.02, 0.0, 0.005])
    plant = FirstOrder(7, 0.002, lambda t: residual)
    found = fit_tracking_model([[excitation_log(plant, random_controls(5, 4000))]], RATE, PERIOD, lag=0.002)
    np.testing.assert_allclose(found.position_errors, SAFETY_FACTOR * residual / RATE, rtol=0.01, atol=1e-4)


def test_an_empty_list_of_logs_is_rejected():
    with pytest.raises(ConfigurationError):
        fit_tracking_model([], RATE, PERIOD)


def test_the_default_drive_stays_within_the_tracking_model_of_its_robot():
    """A short run with another seed, with an empty hand and 0.5 kg, is within the stated tracking model."""
    reported = []
    found = identify_plant(PANDA, seeds=(11,), seconds=1.5, progress=lambda share, text: reported.append((share, text)))
    assert found.lag == pytest.approx(PANDA.tracking.lag, abs=1e-4)
    assert found.position_error / SAFETY_FACTOR < PANDA.tracking.position_error
    assert [share for share, _ in reported] == pytest.approx(np.arange(6) / 6)


def test_the_error_of_the_default_drive_comes_from_the_load():
    empty, loaded = (identify_plant(PANDA, seeds=(0,), seconds=0.5, load=kg) for kg in (0.0, 1.0))
    assert empty.position_error < 5e-6
    assert loaded.position_error > 1e-4


def test_velocity_actuators_have_a_larger_error():
    found, known = identify_plant(PANDA, "velocity", seeds=(0,), seconds=1.0), PANDA.with_drive("velocity").tracking
    assert 0.0 <= found.lag < 0.004
    assert 5.0 * PANDA.tracking.position_error < found.position_error < 1.1 * known.position_error
    assert len(found.largest) == 7


@pytest.mark.parametrize(
    "bad", [{"seeds": ()}, {"seconds": 0.1}, {"seconds": nan}, {"seconds": inf}, {"load": -1.0}, {"load": nan}]
)
def test_invalid_identification_settings_are_rejected(bad):
    with pytest.raises(ConfigurationError, match="at least"):
        identify_plant(PANDA, **bad)


@pytest.mark.parametrize("alpha", [0.5, 2.0, RATE, 5.0, 20.0])
def test_the_budget_covers_other_gains(alpha):
    """At any other rate, the leaky integral times that rate stays within the row margin from the e at one rate."""
    rng = np.random.default_rng(4)
    r = np.repeat(rng.choice((-0.02, 0.0, 0.02), (60, 7)), 100, axis=0)
    log = ExcitationLog(np.cumsum(r, axis=0) * PERIOD, np.zeros_like(r), np.zeros_like(r))
    e = np.abs(leaky_error(log, 0.0, RATE, PERIOD)).max()
    budget = TrackingErrorModel(lag=0.0, position_error=float(e), rate=RATE, provenance="test").row_margins(alpha, 7)
    assert alpha * np.abs(leaky_error(log, 0.0, alpha, PERIOD)).max() <= max(budget) * (1.0 + 1e-9)


def test_the_error_of_the_robot_model_is_never_rounded_down():
    found = fit_tracking_model(
        [[excitation_log(FirstOrder(7, 0.004, lambda t: 0.02), random_controls(3, 400))]], RATE, PERIOD, lag=0.004
    )
    entry = found.to_error_model("velocity", "test")
    assert np.all(np.array(found.position_errors) <= entry.position_error)
    assert np.all(np.array(entry.position_error) < np.array(found.position_errors) + 1e-6)
    assert (entry.drive, entry.rate) == ("velocity", RATE)


@pytest.mark.parametrize("kind", EXCITATION_KINDS)
def test_excitations_are_reproducible_from_their_seed(kind):
    robot_model = load_robot("panda")
    first, second = (excite(FirstOrder(7, 0.002), robot_model, kind, 200, np.random.default_rng(5)) for _ in range(2))
    assert np.array_equal(first.u, second.u)
    change = np.abs(np.diff(first.u, axis=0)).max(axis=0)
    assert np.all(change <= np.array([j.acceleration.value for j in robot_model.joints]) * PERIOD * (1 + 1e-5) + 1e-6)
