"""Control-affine filter: relative degrees and rows against derivations by hand, safe loops and negative controls."""

import sys
from ctypes import c_int
from functools import cache

import casadi as ca
import daqp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.safety.cbf.result import FilterStatus, Reason
from dualbrain.safety.cbf.rows import Rank
from dualbrain.safety.control_affine import Barrier, ControlAffine, ControlAffineFilter

STATE = st.floats(-2.0, 2.0)
NOMINAL = st.floats(-60.0, 60.0)

# --- systems of the literature, in casadi and in numpy ------------------------------------------------------------

MASS, HEADWAY, BRAKE = 1650.0, 1.8, 0.3 * 9.81
INERTIA, GRAVITY, LEAN = 2.0, 10.0, 0.3
CENTRE, RADIUS = np.array([2.0, 0.3]), 0.7


def drag(v):
    return 0.1 + 5.0 * v + 0.25 * v**2


@cache
def car(braking=False, alpha=5.0, margin=0.0):
    """Adaptive cruise control (Ames et al., CDC 2014): own speed, speed of the lead car, distance; u is the force."""
    x = ca.SX.sym("x", 3)
    system = ControlAffine(x, [-drag(x[0]) / MASS, 0.0, x[1] - x[0]], [1.0 / MASS, 0.0, 0.0])
    h = x[2] - HEADWAY * x[0]
    if braking:
        h -= 0.5 * ca.fmax(x[0] - x[1], 0.0) ** 2 / BRAKE
    limit = BRAKE * MASS
    barrier = Barrier(name="headway", h=h, alphas=alpha, margin=margin)
    faster = ([15.0, 0.0, 10.0], [30.0, 14.0, 200.0])
    return ControlAffineFilter(system, [barrier], -limit, limit, fallback=-limit, domain=faster)


def car_rate(x, u):
    return np.array([(u[0] - drag(x[0])) / MASS, 0.0, x[1] - x[0]])


@cache
def cart(a1=1.0, a2=4.0, **options):
    x = ca.SX.sym("x", 2)
    return ControlAffineFilter(
        ControlAffine(x, [x[1], 0], [0, 1]), [Barrier(name="wall", h=x[0], alphas=(a1, a2))], **options
    )


def cart_rate(x, u):
    return np.array([x[1], u[0]])


@cache
def pendulum(a1=3.0, a2=6.0, torque=40.0, margin=0.3):
    x = ca.SX.sym("x", 2)
    system = ControlAffine(x, [x[1], GRAVITY * ca.sin(x[0])], [0, 1.0 / INERTIA])
    sides = [
        Barrier(name=name, h=LEAN + sign * x[0], alphas=(a1, a2), margin=margin)
        for name, sign in (("right", -1.0), ("left", 1.0))
    ]
    return ControlAffineFilter(system, sides, -torque, torque)


def pendulum_rate(x, u):
    return np.array([x[1], GRAVITY * np.sin(x[0]) + u[0] / INERTIA])


@cache
def unicycle(a1=1.0, a2=2.0, margin=0.0):
    """Position, heading and speed, controlled by turn rate and acceleration (Xiao and Belta, CDC 2019)."""
    x = ca.SX.sym("x", 4)
    system = ControlAffine(x, [x[3] * ca.cos(x[2]), x[3] * ca.sin(x[2]), 0, 0], [[0, 0], [0, 0], [1, 0], [0, 1]])
    disc = Barrier(name="disc", h=ca.sumsqr(x[:2] - CENTRE) - RADIUS**2, alphas=(a1, a2), margin=margin)
    weight = np.diag([0.02, 1.0])
    return ControlAffineFilter(system, [disc], -2.0, 2.0, weight=weight, domain=(0.1, 1.5))


def unicycle_rate(x, u):
    return np.array([x[3] * np.cos(x[2]), x[3] * np.sin(x[2]), u[0], u[1]])


def step(rate, x, u, dt):
    """One Runge-Kutta step with a constant control."""
    k1 = rate(x, u)
    k2 = rate(x + 0.5 * dt * k1, u)
    k3 = rate(x + 0.5 * dt * k2, u)
    k4 = rate(x + dt * k3, u)
    return x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def closed_loop(safety, rate, x, nominal, steps, dt):
    """States (steps, n) and statuses; without a filter the nominal control is applied."""
    x, states, statuses = np.array(x, float), [], []
    for k in range(steps):
        u = np.atleast_1d(nominal(x, k))
        if safety is not None:
            answer = safety(x, u)
            u = answer.u
            statuses.append(answer.status)
        x = step(rate, x, u, dt)
        states.append(x)
    return np.array(states), statuses


# --- relative degree ----------------------------------------------------------------------------------------------


def chain(length):
    x = ca.SX.sym("x", length)
    return ControlAffine(x, [*(x[i] for i in range(1, length)), 0.0], [*([0.0] * (length - 1)), 1.0]), x[0]


@pytest.mark.parametrize("length", [1, 2, 3, 5])
def test_a_chain_of_integrators_has_the_degree_of_its_length(length):
    system, h = chain(length)
    assert ControlAffineFilter(system, [Barrier(name="end", h=h)]).relative_degrees == (length,)


def test_degrees_of_the_literature():
    assert car().relative_degrees == car(braking=True).relative_degrees == (1,)
    assert cart().relative_degrees == unicycle().relative_degrees == (2,)
    assert pendulum().relative_degrees == (2, 2)


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_a_control_that_cancels_up_to_rounding_does_not_count(kind):
    """L_g h = −cos φ sin φ + sin φ cos φ is zero, but not structurally."""
    x = kind.sym("x", 4)  # position (2), speed along φ, φ
    c, s = ca.cos(x[3]), ca.sin(x[3])
    system = ControlAffine(x, [x[2] * c, x[2] * s, 0, 0], [[-s, 0], [c, 0], [0, 1], [0, 0]])
    safety = ControlAffineFilter(system, [Barrier(name="along", h=c * x[0] + s * x[1], alphas=(1.0, 2.0))])
    assert safety.relative_degrees == (2,)
    A, b = safety.rows(np.array([0.4, 0.3, -0.5, 0.7]))
    np.testing.assert_allclose(A, [[0.0, 1.0]], atol=1e-12)
    along = np.cos(0.7) * 0.4 + np.sin(0.7) * 0.3
    np.testing.assert_allclose(b, [-(3.0 * -0.5 + 2.0 * along)], atol=1e-12)


def test_a_sum_that_is_zero_up_to_rounding_does_not_count():
    """0.1 x + 0.2 x − 0.3 x is zero, but not in floating point."""
    x = ca.SX.sym("x", 4)
    tenths = [0.1 * x[3], 0.2 * x[3], 0.3 * x[3]]
    system = ControlAffine(x, [x[3], 0, 0, 0], [*([part, 0] for part in tenths), [0, 1]])
    assert ControlAffineFilter(system, [Barrier(name="sum", h=x[0] + x[1] - x[2])]).relative_degrees == (2,)


# --- rows and results against closed forms ------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(v=st.floats(0.0, 35.0), lead=st.floats(0.0, 35.0), D=st.floats(0.0, 120.0), desired=st.floats(-9e3, 9e3))
def test_cruise_control_agrees_with_the_literature(v, lead, D, desired):
    """The control is min(u_nom, m/1.8 (v_l − v + 1.8 F_r/m + α h)) within the limits of the force."""
    safety = car()
    bound = MASS / HEADWAY * (lead - v + HEADWAY * drag(v) / MASS + 5.0 * (D - HEADWAY * v))
    answer = safety([v, lead, D], [desired])
    limit = BRAKE * MASS
    assert answer.u[0] == pytest.approx(np.clip(min(desired, bound), -limit, limit), abs=1e-5)
    assert answer.h[0] == pytest.approx(D - HEADWAY * v, abs=1e-9)
    if min(desired, bound) < -limit - 1e-3 and bound < -limit - 1e-3:
        assert answer.status is FilterStatus.RELAXED


@settings(max_examples=60, deadline=None)
@given(p=STATE, v=STATE, desired=NOMINAL)
def test_double_integrator_agrees_with_the_closed_form(p, v, desired):
    safety = cart(1.5, 3.0)
    answer = safety([p, v], [desired])
    assert answer.u[0] == pytest.approx(max(desired, -4.5 * v - 4.5 * p), abs=1e-9)
    assert answer.psi[0] == pytest.approx((p, v + 1.5 * p), abs=1e-12)
    assert answer.certified == (p >= 0.0 and v + 1.5 * p >= 0.0)
    assert answer.violated_barriers == (() if answer.certified else ("wall",))


@settings(max_examples=60, deadline=None)
@given(lean=st.floats(-0.3, 0.3), rate=st.floats(-1.0, 1.0), desired=st.floats(-40.0, 40.0))
def test_pendulum_agrees_with_the_closed_form(lean, rate, desired):
    safety = pendulum(margin=0.0)
    high = INERTIA * (-9.0 * rate + 18.0 * (LEAN - lean) - GRAVITY * np.sin(lean))
    low = INERTIA * (-9.0 * rate - 18.0 * (LEAN + lean) - GRAVITY * np.sin(lean))
    answer = safety([lean, rate], [desired])
    if low <= high and high > -40.0 and low < 40.0:
        assert answer.u[0] == pytest.approx(np.clip(np.clip(desired, low, high), -40.0, 40.0), abs=1e-8)


@settings(max_examples=60, deadline=None)
@given(x=st.tuples(STATE, STATE, STATE, STATE))
def test_unicycle_rows_are_those_of_xiao_and_belta(x):
    safety = unicycle(1.0, 2.0)
    dx, dy, c, s, v = x[0] - CENTRE[0], x[1] - CENTRE[1], np.cos(x[2]), np.sin(x[2]), x[3]
    h, rate = dx**2 + dy**2 - RADIUS**2, 2.0 * v * (dx * c + dy * s)
    A, b = safety.rows(np.array(x))
    np.testing.assert_allclose(A, [[2.0 * v * (dy * c - dx * s), 2.0 * (dx * c + dy * s)]], atol=1e-10)
    np.testing.assert_allclose(b, [-(2.0 * v**2 + 3.0 * rate + 2.0 * h)], atol=1e-10)


def test_psi_and_rows_agree_with_finite_differences_along_motions():
    """A general system with a nonlinear class-K function: ψ̇ by differences of ψ along a motion."""
    x = ca.SX.sym("x", 3)
    f = [x[1] * ca.cos(x[2]), -ca.sin(x[0]) + 0.3 * x[2] ** 2, 0.2 * x[0] * x[1]]
    g = [[0, 0], [1.0 + 0.5 * ca.cos(x[0]), 0.2], [0.1 * x[1], 2.0]]
    h = 1.0 + x[0] - 0.2 * x[0] ** 2
    system = ControlAffine(x, f, g)
    cubic = Barrier(name="cubic", h=h, alphas=(1.3, lambda psi: 0.7 * psi + 0.2 * psi**3))
    safety = ControlAffineFilter(system, [cubic])
    F = ca.Function("F", [x], [ca.vertcat(*f), system.g])

    def rate(state, u):
        drift, columns = (np.array(part) for part in F(state))
        return drift.ravel() + columns @ u

    rng, dt = np.random.default_rng(2), 1e-5
    for _ in range(20):
        state, u = rng.uniform(-0.8, 0.8, 3), rng.uniform(-1.0, 1.0, 2)
        ahead, back = step(rate, state, u, dt), step(rate, state, u, -dt)
        here, later, before = (np.array(safety(z, u).psi[0]) for z in (state, ahead, back))
        slope = (later - before) / (2.0 * dt)
        assert here[1] == pytest.approx(slope[0] + 1.3 * here[0], abs=1e-7)
        A, b = safety.rows(state)
        row = slope[1] + 0.7 * here[1] + 0.2 * here[1] ** 3
        assert (A @ u - b)[0] == pytest.approx(row, abs=1e-6)


def test_several_barriers_and_controls_agree_with_another_solver(rng):
    x = ca.SX.sym("x", 3)
    system = ControlAffine(x, [0.1 * x[1], -x[0], 0], [[1, 0.2, 0], [0, 1, 0], [0.3, 0, 1]])
    barriers = [
        Barrier(name="ball", h=1.0 - ca.sumsqr(x), alphas=2.0),
        Barrier(name="plane", h=0.5 + x[0] - 0.3 * x[2], alphas=1.0),
        Barrier(name="roof", h=0.6 - x[1], alphas=3.0),
    ]
    weight = np.diag([1.0, 4.0, 0.5])
    safety = ControlAffineFilter(system, barriers, -3.0, 3.0, weight=weight)
    changed = 0
    for _ in range(100):
        state, desired = rng.uniform(-0.5, 0.5, 3), rng.uniform(-3.0, 3.0, 3)
        A, b = safety.rows(state)
        high, low = np.concatenate([np.full(3, 3.0), np.full(3, 1e30)]), np.concatenate([np.full(3, -3.0), b])
        best, _, flag, _ = daqp.solve(weight, -weight @ desired, A, high, low, np.zeros(6, dtype=c_int))
        assert flag == 1
        answer = safety(state, desired)
        np.testing.assert_allclose(answer.u, best, atol=1e-6)
        changed += answer.status is FilterStatus.MODIFIED
        assert {name for name, _ in answer.active_rows} <= {
            "ball",
            "plane",
            "roof",
            *(f"u[{k}] {s}" for k in range(3) for s in ("lower", "upper")),
        }
    assert 20 < changed < 100


# --- closed loops and negative controls ---------------------------------------------------------------------------


def cruise(safety):
    limit = BRAKE * MASS
    states, statuses = closed_loop(
        safety,
        car_rate,
        [20.0, 14.0, 100.0],
        lambda x, _: np.clip(5.0 * MASS * (24.0 - x[0]), -limit, limit),
        1200,
        0.05,
    )
    return (states[:, 2] - HEADWAY * states[:, 0]).min(), statuses


def test_cruise_control_keeps_its_headway():
    least, statuses = cruise(car(braking=True, margin=0.5))
    assert least >= 0.0
    assert set(statuses) <= {FilterStatus.SAFE, FilterStatus.MODIFIED}
    assert cruise(None)[0] < -100.0
    least, statuses = cruise(car(braking=False))  # a barrier without braking distance
    assert least < -1.0
    assert FilterStatus.RELAXED in statuses


def test_double_integrator_follows_the_exact_solution():
    a1, a2, dt = 1.0, 4.0, 1e-3
    states, _ = closed_loop(cart(a1, a2), cart_rate, [1.0, 0.0], lambda *_: -200.0, 2000, dt)
    t = dt * np.arange(1, 2001)
    exact = (a2 * np.exp(-a1 * t) - a1 * np.exp(-a2 * t)) / (a2 - a1)
    np.testing.assert_allclose(states[:, 0], exact, atol=6e-4)
    assert states[:, 0].min() > 0.0
    assert closed_loop(None, cart_rate, [1.0, 0.0], lambda *_: -200.0, 400, dt)[0][:, 0].min() < -1.0


def test_gains_beyond_the_box_break_the_wall():
    """With 1 m/s², gains of 0.7 stop from 1 m/s in time; gains of 10 need more acceleration at the end."""

    def least(a1, a2):
        safety = cart(a1, a2, lower=-1.0, upper=1.0, fallback=1.0)
        states, statuses = closed_loop(safety, cart_rate, [2.0, 0.0], lambda *_: -1.0, 1600, 5e-3)
        return states[:, 0].min(), FilterStatus.RELAXED in statuses

    low, was_relaxed = least(0.7, 0.7)
    assert low >= 0.0
    assert not was_relaxed
    low, was_relaxed = least(10.0, 10.0)
    assert low < -0.1
    assert was_relaxed


def test_pendulum_never_leans_too_far(rng):
    signs = rng.choice([-1.0, 1.0], 20)
    push = lambda _, k: 40.0 * signs[k // 100]  # noqa: E731
    states, statuses = closed_loop(pendulum(), pendulum_rate, [0.0, 0.0], push, 2000, 2e-3)
    assert np.abs(states[:, 0]).max() <= LEAN
    assert np.abs(states[:, 0]).max() > 0.25
    assert max(statuses) is FilterStatus.MODIFIED
    assert np.abs(closed_loop(None, pendulum_rate, [0.0, 0.0], push, 400, 2e-3)[0][:, 0]).max() > 1.0


def test_unicycle_steers_around_the_disc():
    def nominal(x, _):
        return np.array([-x[2] - 0.5 * x[1], 2.0 * (1.0 - x[3])])

    start = [0.0, 0.0, 0.0, 0.5]
    states, statuses = closed_loop(unicycle(margin=0.05), unicycle_rate, start, nominal, 1000, 0.01)
    gap = np.linalg.norm(states[:, :2] - CENTRE, axis=1) - RADIUS
    assert gap.min() >= 0.0
    assert states[-1, 0] > 4.0  # it drove around the disc and did not stop
    assert max(statuses) is FilterStatus.MODIFIED
    free = closed_loop(None, unicycle_rate, start, nominal, 1000, 0.01)[0]
    assert (np.linalg.norm(free[:, :2] - CENTRE, axis=1) - RADIUS).min() < -0.1


# --- safe input, conflicts and invalid input ----------------------------------------------------------------------


def test_a_strictly_safe_control_is_returned_bit_for_bit():
    desired = np.array([1.0 / 3.0])
    answer = cart()([1.0, 0.1], desired)
    assert answer.status is FilterStatus.SAFE
    assert np.array_equal(answer.u, desired)
    assert answer.delta == 0.0
    assert answer.explain() == "passed unchanged"


def test_conflicting_barriers_are_relaxed_by_rank_and_named():
    x = ca.SX.sym("x")
    system = ControlAffine(x, [0], [1])
    person = Barrier(name="person", h=-x, alphas=1.0, margin=1.0, rank=Rank.BODY)  # u ≤ −1 at x = 0
    parcel = Barrier(name="parcel", h=x, alphas=1.0, margin=2.0, rank=Rank.TASK)  # u ≥ 2
    for order in ([person, parcel], [parcel, person]):
        answer = ControlAffineFilter(system, order, -5.0, 5.0)([0.0], [0.5])
        assert answer.status is FilterStatus.RELAXED
        assert answer.reason is Reason.INFEASIBLE
        assert {name for name, _ in answer.active_rows} == {"person", "parcel"}
        assert answer.relaxed_ranks == (Rank.TASK,)
        assert answer.u[0] == pytest.approx(-1.0, abs=1e-6)
        assert "person" in answer.explain()


def test_a_row_outside_the_conflict_is_satisfied():
    x = ca.SX.sym("x", 2)
    right, left = (
        Barrier(name="right", h=x[0], margin=0.8),
        Barrier(name="left", h=-x[0], margin=0.4),
    )  # u_0 ≥ 0.8, u_0 ≤ −0.4
    ahead = Barrier(name="ahead", h=x[1], margin=0.7)  # u_1 ≥ 0.7
    answer = ControlAffineFilter(ControlAffine(x, [0, 0], np.eye(2)), [right, ahead, left], -1.0, 1.0)([0, 0], [0, 0])
    assert answer.status is FilterStatus.RELAXED
    np.testing.assert_allclose(answer.u, [0.2, 0.7], atol=1e-6)


def test_conflicting_rows_are_violated_least_and_never_more_than_by_the_fallback(rng):
    x = ca.SX.sym("x", 2)
    system = ControlAffine(x, [0, 0], [[1, 0.4], [0, 1]])
    cases = 0
    for _ in range(60):
        sides = rng.normal(size=(4, 2))
        barriers = [
            Barrier(
                name=f"side{i}", h=float(a) * x[0] + float(b) * x[1], alphas=1.0, margin=float(rng.uniform(-0.5, 1.5))
            )
            for i, (a, b) in enumerate(sides)
        ]
        fallback = rng.uniform(-1.0, 1.0, 2)
        safety = ControlAffineFilter(system, barriers, -1.0, 1.0, fallback=fallback)
        state = rng.uniform(-0.3, 0.3, 2)
        A, b = safety.rows(state)
        answer = safety(state, rng.uniform(-1.0, 1.0, 2))
        if answer.status is not FilterStatus.RELAXED:
            continue
        cases += 1
        size = np.abs(A).sum(axis=1)
        assert np.all(A @ answer.u >= np.minimum(b, A @ fallback) - 1e-7)
        assert np.all(np.abs(answer.u) <= 1.0)
        tries = np.array(np.meshgrid(np.linspace(-1, 1, 81), np.linspace(-1, 1, 81))).reshape(2, -1).T
        allowed = tries[np.all(tries @ A.T >= np.minimum(b, A @ fallback), axis=1)]
        if len(allowed):  # no grid point is better
            best = ((b - allowed @ A.T) / size).max(axis=1).min()
            assert ((b - A @ answer.u) / size).max() <= best + 1e-6
    assert cases > 10


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_input_that_is_not_finite_returns_the_fallback(bad):
    safety = cart(lower=-5.0, upper=5.0, fallback=2.0)
    for x, u in (([bad, 0.0], [0.0]), ([1.0, bad], [0.0]), ([1.0, 0.0], [bad])):
        answer = safety(x, u)
        assert answer.status is FilterStatus.STOPPED
        assert answer.reason is Reason.BAD_INPUT
        assert answer.u.tolist() == [2.0]
        assert np.isfinite(answer.delta)
        assert not answer.certified


def test_a_state_without_control_authority_is_reported():
    """L_g L_f h of θ_max² − θ² vanishes upright: outside the safe set no control helps there (RELAXED)."""
    x = ca.SX.sym("x", 2)
    system = ControlAffine(x, [x[1], 0], [0, 1])
    safety = ControlAffineFilter(system, [Barrier(name="lean", h=LEAN**2 - x[0] ** 2, alphas=(1.0, 1.0))], -1.0, 1.0)
    answer = safety([0.0, 3.0], [0.0])
    assert answer.status is FilterStatus.RELAXED
    assert np.isfinite(answer.u).all()


# --- invalid configurations ---------------------------------------------------------------------------------------


def assert_rejected(make, *words):
    with pytest.raises(ConfigurationError) as caught:
        make()
    for word in words:
        assert word in str(caught.value)


def test_invalid_configurations_state_the_reason():
    x, y = ca.SX.sym("x", 2), ca.SX.sym("y")
    system = ControlAffine(x, [x[1], 0], [0, 1])
    assert_rejected(lambda: ControlAffineFilter(system, [Barrier(name="b", h=1.0)]), "'b'", "in the state")
    assert_rejected(lambda: ControlAffineFilter(system, [Barrier(name="b", h=x[0] - x[0])]), "'b'", "in the state")
    assert_rejected(lambda: ControlAffineFilter(system, [Barrier(name="b", h=y)]), "in the state")
    assert_rejected(lambda: ControlAffineFilter(system, [Barrier(name="b", h=x)]), "one number")
    assert_rejected(
        lambda: ControlAffineFilter(system, [Barrier(name="b", h=ca.fmax(x[0], 0.3))]), "more at the others", "domain"
    )
    assert_rejected(
        lambda: ControlAffineFilter(system, [Barrier(name="b", h=ca.sqrt(x[0] - 9.0))]), "no finite value", "domain"
    )
    unreachable = ControlAffine(x, [0, 0], [0, 1])
    assert_rejected(
        lambda: ControlAffineFilter(unreachable, [Barrier(name="b", h=x[0])]), "none up to 2", "controls can change"
    )
    assert_rejected(
        lambda: ControlAffineFilter(system, [Barrier(name="b", h=x[0], alphas=(1.0, 2.0, 3.0))]),
        "alphas",
        "2, one for each",
    )
    assert_rejected(lambda: ControlAffineFilter(system, [Barrier(name="b", h=x[0], alphas=-1.0)]), "above 0")
    assert_rejected(lambda: ControlAffineFilter(system, []), "one or more")
    assert_rejected(lambda: ControlAffineFilter(system, [Barrier(name="b", h=x[0])] * 2), "distinct names")
    assert_rejected(lambda: ControlAffineFilter(system, [Barrier(name="b", h=x[0])], 1.0, -1.0), "lower ≤ upper")
    assert_rejected(
        lambda: ControlAffineFilter(system, [Barrier(name="b", h=x[0])], weight=np.array([[-1.0]])), "positive definite"
    )
    wide = ControlAffine(x, [x[1], 0], np.ones((2, 9)))
    assert_rejected(lambda: ControlAffineFilter(wide, [Barrier(name="b", h=x[0])]), "1 to 8")
    assert_rejected(lambda: ControlAffine(x, [x[1]], [0, 1]), "shape of f")
    assert_rejected(lambda: ControlAffine(x, [x[1], 0], [0, 1, 2]), "shape of g")
    assert_rejected(lambda: ControlAffine(x, [x[1], y], [0, 1]), "free symbols")
    assert_rejected(lambda: ControlAffine(2 * x, [x[1], 0], [0, 1]), "column of casadi symbols")
    assert_rejected(lambda: ControlAffine(np.zeros(2), [0, 0], [0, 1]), "column of casadi symbols")
    safety = ControlAffineFilter(system, [Barrier(name="b", h=x[0])])
    assert_rejected(lambda: safety([1.0, 2.0, 3.0], [0.0]), "size of state")
    assert_rejected(lambda: safety([1.0, 2.0], [0.0, 1.0]), "size of u_nom")


def test_without_casadi_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(MissingDependencyError, match=r"dualbrain\[symbolic\]"):
        ControlAffine(None, None, None)
