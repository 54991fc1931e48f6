"""The QP of the kernel against a numpy implementation of its method: equal constraints, multipliers and iterations."""

import numpy as np
import pytest

from dualbrain.safety.cbf.compiled import _kernel64
from tests.safety.kernel_step import random_cases
from tests.safety.kernel_step.reference_active_set import DEPENDENCE_TOLERANCE, ReferenceQP


def problem(rng, *, slack):
    """Generic rows around a direction, so that several bind; sometimes with two that contradict each other."""
    n, m = int(rng.integers(1, 9)), int(rng.integers(1, 30))
    A = rng.normal(size=(m, n)) + rng.normal(size=n)
    A /= np.linalg.norm(A, axis=1, keepdims=True)
    b = rng.uniform(-1.0, 0.4, m)
    if m > 3 and rng.random() < 0.3:
        A[1], b[0], b[1] = -A[0] + 1e-3 * rng.normal(size=n), 0.2, 0.2
        A[1] /= np.linalg.norm(A[1])
    soft = rng.uniform(0.05, 1.0, m) * (rng.random(m) < 0.8)
    limit = rng.uniform(0.3, 2.0, n)
    return ReferenceQP(
        random_cases.random_scale(rng, n), A, b, soft, -limit, limit, rng.uniform(-2.5, 2.5, n), slack=slack
    )


def kernel(p, warm=(), shift=0.0):
    u = np.empty(p.n)
    rows = tuple(np.ascontiguousarray(part) for part in (p.A, p.b, p.soft))
    found = _kernel64.solve_qp_warm(p.S, rows, p.low, p.high, p.u_nom, p.with_slack, shift, list(warm), u)
    return (u, *found)


def agree(p, warm=()):
    """Assert that both take the same steps; returns the active set."""
    expected = p.solve(warm)
    u, result, iterations, slack, active = kernel(p, warm)
    assert result == expected
    if result == 1:  # rounding may change the order of removals; the certificate must be valid
        total = sum(weight * p.normal(at) for at, weight in active)
        np.testing.assert_allclose(total, 0.0, atol=1e-6)
        assert all(weight > -1e-9 for _, weight in active)
        assert abs(iterations - p.iterations) < 4
        return []
    assert iterations == p.iterations
    assert [at for at, _ in active] == p.active
    np.testing.assert_allclose([weight for _, weight in active], p.multiplier, atol=1e-6, rtol=1e-6)
    np.testing.assert_allclose(u, p.u, atol=1e-8)
    assert slack == pytest.approx(p.slack, abs=1e-8)
    return p.active


@pytest.mark.parametrize("slack", [False, True])
def test_it_takes_the_same_steps(slack):
    rng = np.random.default_rng(5 + slack)
    kinds = []
    for _ in range(250):
        p = problem(rng, slack=slack)
        active = agree(p)
        kinds.append((len(active) > 1, p.iterations > len(active), not active))
    assert np.all(np.sum(kinds, axis=0) > 10), "several active rows, some removed again, some infeasible"


@pytest.mark.parametrize("slack", [False, True])
def test_it_starts_from_the_previous_active_set(slack):
    """From its own solution no iteration is needed; from another active set it takes the same steps as numpy."""
    rng = np.random.default_rng(9)
    for _ in range(120):
        first = problem(rng, slack=slack)
        active = agree(first)
        parts = (first.S, first.A, first.b, first.soft, first.low, first.high)
        if len(active) <= first.n:
            again = ReferenceQP(*parts, first.u_nom, slack=slack)
            agree(again, active)
            assert again.iterations == 0 or not active
        other = ReferenceQP(*parts, first.u_nom + 0.3 * rng.normal(size=first.n), slack=slack)
        agree(other, [*active, *rng.permutation(2 * first.n + len(first.b))[:3]])


def test_rows_are_tightened_by_the_shift():
    rng = np.random.default_rng(2)
    for _ in range(40):
        p = problem(rng, slack=False)
        q = ReferenceQP(p.S, p.A, p.b + 0.01, p.soft, p.low, p.high, p.u_nom, slack=False)
        u, result, *_ = kernel(p, shift=0.01)
        assert result == q.solve()
        if result == 0:
            np.testing.assert_allclose(u, q.u, atol=1e-8)


@pytest.mark.parametrize(("angle", "expected"), [(0.9 * DEPENDENCE_TOLERANCE, 1), (1.1 * DEPENDENCE_TOLERANCE, 0)])
def test_a_row_depends_on_another_up_to_a_stated_angle(angle, expected):
    """Two opposing rows, nearly parallel: below the angle they have no common solution."""
    A = np.array([[1.0, 0.0], [-np.cos(angle), np.sin(angle)]])
    p = ReferenceQP(
        np.eye(2),
        A,
        np.array([0.0, 0.4 * angle]),
        np.zeros(2),
        -np.ones(2),
        np.ones(2),
        np.array([-0.5, 0.0]),
        slack=False,
    )
    assert kernel(p)[1] == expected


@pytest.mark.parametrize(("missing", "iterations"), [(0.9e-11, 0), (1.2e-11, 1)])
def test_the_tolerance_of_a_satisfied_row(missing, iterations):
    for A, b, low in ((np.array([[1.0]]), missing, -1.0), (np.array([[0.6]]), -1.0, missing)):
        p = ReferenceQP(np.eye(1), A, np.array([b]), np.zeros(1), np.array([low]), np.ones(1), np.zeros(1), slack=False)
        assert kernel(p)[2] == iterations


def test_problems_stay_below_the_iteration_limit():
    """No problem of this size reaches the iteration limit."""
    rng = np.random.default_rng(1)
    longest = 0
    for _ in range(300):
        p = problem(rng, slack=True)
        longest = max(longest, kernel(p)[2])
    assert 8 < longest < 80


def test_the_check_covers_box_rows_and_finiteness():
    rng = np.random.default_rng(3)
    for _ in range(60):
        n, m = int(rng.integers(1, 9)), int(rng.integers(0, 20))
        A, u, tolerance = rng.normal(size=(m, n)), rng.uniform(-1.0, 1.0, n), float(rng.choice([0.0, 0.1]))
        b, low, high = A @ u, u - 0.1, u + 0.1

        def passes(u=u, b=b, low=low, high=high, A=A, tolerance=tolerance):
            return _kernel64.check(np.ascontiguousarray(A), b, low, high, u, tolerance)

        assert passes(b=b + tolerance - 1e-9)
        assert passes(low=u, high=u, b=b - 1e-9)
        for k in range(n):
            one = np.eye(n)[k]
            assert not passes(low=low + 0.2 * one, b=b - 1e3)
            assert not passes(high=high - 0.2 * one, b=b - 1e3)
            for wrong in (np.nan, np.inf):
                v = u.copy()
                v[k] = wrong
                assert not passes(u=v, b=b - 1e9, high=np.full(n, np.inf))
        for r in range(m):
            assert not passes(b=b + (tolerance + 2e-9) * np.eye(m)[r] - 1e-9)
