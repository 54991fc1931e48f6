"""The tracking model: a known plant is recovered, and the leaky integral really bounds what a barrier loses."""

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
        """Nothing to do."""

    def apply(self, u):
        u = u + self.residual(self.t * PERIOD)
        fade = np.exp(-PERIOD / self.lag)
        self.q = self.q + u * PERIOD + (self.v - u) * self.lag * (1.0 - fade)
        self.v = u + (self.v - u) * fade
        self.t += 1


def driven(plant, u):
    """Log of `plant` under given controls (t, n)."""
    q, v = np.empty_like(u), np.empty_like(u)
    for t, control in enumerate(u):
        q[t], v[t] = plant.q, plant.v
        plant.apply(control)
    return ExcitationLog(q, v, u)


def wandering(seed, steps=3000, n=7):
    rng = np.random.default_rng(seed)
    t = np.arange(steps)[:, None] * PERIOD
    return 2.0 * np.sin(rng.uniform(1.0, 9.0, n) * t + rng.uniform(0.0, 6.0, n))


@settings(max_examples=10, deadline=None)
@given(st.floats(0.0005, 0.03), st.integers(0, 10**6))
def test_a_known_lag_is_recovered(lag, seed):
    found = fit_tracking_model([[driven(FirstOrder(7, lag), wandering(seed))]], RATE, PERIOD)
    assert found.lag == pytest.approx(lag, abs=3e-6)
    assert found.position_error < 1e-4


def test_a_constant_residual_gives_r_over_alpha():
    """∫ exp(−α s) r ds = r/α in the long run; through u alone, so that the lag stays what it is."""
    plant = FirstOrder(7, 0.004, lambda t: 0.02)
    found = fit_tracking_model([[driven(plant, wandering(3, 4000))]], RATE, PERIOD, lag=0.004)
    assert found.position_error == pytest.approx(SAFETY_FACTOR * 0.02 / RATE, rel=0.01)
    assert found.tracking_error == pytest.approx(SAFETY_FACTOR * 0.02, rel=0.01)
    assert found.velocity_error == pytest.approx(0.02, rel=1e-3)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from((0.05, 0.3, 3.0)))
def test_the_leaky_integral_bounds_what_a_barrier_loses(seed, pace):
    """A wall ahead of two joints, u = −α h at the measured y: h never falls below −Σ |a_k| e_k."""
    rng = np.random.default_rng(seed)
    a, amplitude, phase = rng.uniform(-1.0, 1.0, 2), rng.uniform(0.0, 0.1, 2), rng.uniform(0.0, 6.0, 2)
    plant = FirstOrder(2, 0.003, lambda t: amplitude * np.sign(np.sin(2.0 * np.pi * pace * t + phase)))
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


def test_two_sigma_and_the_factor_are_over_seeds():
    logs = [[driven(FirstOrder(7, 0.002, lambda t, r=r: r), wandering(i))] for i, r in enumerate((0.01, 0.02))]
    found = fit_tracking_model(logs, RATE, PERIOD, lag=0.002)
    spread = np.mean(found.by_seed) + 2.0 * np.std(found.by_seed, ddof=1)
    assert found.position_error == pytest.approx(SAFETY_FACTOR * max(*found.by_seed, spread))
    assert found.position_error >= SAFETY_FACTOR * max(found.largest)


def test_too_little_is_refused():
    with pytest.raises(ConfigurationError):
        fit_tracking_model([], RATE, PERIOD)


def test_the_default_drive_keeps_what_its_body_says():
    """One short run with other random numbers, empty hand and half a kilogram, is inside the figures in the rows."""
    told = []
    found = identify_plant(PANDA, seeds=(11,), seconds=1.5, progress=lambda share, word: told.append((share, word)))
    assert found.lag == pytest.approx(PANDA.tracking.lag, abs=1e-4)
    assert found.position_error / SAFETY_FACTOR < PANDA.tracking.position_error
    assert [share for share, _ in told] == pytest.approx(np.arange(6) / 6)


def test_the_load_is_what_the_default_drive_errs_by():
    empty, loaded = (identify_plant(PANDA, seeds=(0,), seconds=0.5, load=kg) for kg in (0.0, 1.0))
    assert empty.position_error < 5e-6
    assert loaded.position_error > 1e-4


def test_velocity_actuators_need_more_and_less_lag():
    found, known = identify_plant(PANDA, "velocity", seeds=(0,), seconds=1.0), PANDA.with_drive("velocity").tracking
    assert 0.0 <= found.lag < 0.004
    assert 5.0 * PANDA.tracking.position_error < found.position_error < 1.1 * known.position_error
    assert len(found.largest) == 7


@pytest.mark.parametrize("bad", [{"seeds": ()}, {"seconds": 0.1}, {"load": -1.0}])
def test_what_cannot_be_identified_is_refused(bad):
    with pytest.raises(ConfigurationError, match="at least"):
        identify_plant(PANDA, **bad)


@pytest.mark.parametrize("alpha", [0.5, 2.0, RATE, 5.0, 20.0])
def test_the_budget_covers_other_gains(alpha):
    """The leaky integral at any other rate, times that rate, stays within the budget of the e found at one rate."""
    rng = np.random.default_rng(4)
    r = np.repeat(rng.choice((-0.02, 0.0, 0.02), (60, 7)), 100, axis=0)
    log = ExcitationLog(np.cumsum(r, axis=0) * PERIOD, np.zeros_like(r), np.zeros_like(r))
    e = np.abs(leaky_error(log, 0.0, RATE, PERIOD)).max()
    budget = TrackingErrorModel(lag=0.0, position_error=float(e), rate=RATE, provenance="test").row_margin(alpha)
    assert alpha * np.abs(leaky_error(log, 0.0, alpha, PERIOD)).max() <= budget * (1.0 + 1e-9)


def test_what_enters_the_body_is_never_rounded_down():
    found = fit_tracking_model(
        [[driven(FirstOrder(7, 0.004, lambda t: 0.02), wandering(3, 400))]], RATE, PERIOD, lag=0.004
    )
    entry = found.to_error_model("velocity", "test")
    assert found.position_error <= entry.position_error < found.position_error + 1e-6
    assert (entry.drive, entry.rate) == ("velocity", RATE)


@pytest.mark.parametrize("kind", EXCITATION_KINDS)
def test_excitations_repeat_from_their_seed(kind):
    robot_model = load_robot("panda")
    first, second = (excite(FirstOrder(7, 0.002), robot_model, kind, 200, np.random.default_rng(5)) for _ in range(2))
    assert np.array_equal(first.u, second.u)
    change = np.abs(np.diff(first.u, axis=0)).max(axis=0)
    assert np.all(change <= np.array([j.acceleration.value for j in robot_model.joints]) * PERIOD * (1 + 1e-5) + 1e-6)
