"""The QP against DAQP and PIQP: generic, degenerate and infeasible problems."""

from ctypes import c_int

import daqp
import numpy as np
import piqp
import pytest

from dualbrain.safety.cbf.compiled import _kernel, _kernel64


def problem(rng, n=7):
    """A random problem: generic, near-duplicate rows, low rank, zero rows, infeasible, or with a general weight R."""
    m = int(rng.integers(1, 60))
    A, b = rng.normal(size=(m, n)), rng.uniform(-2.0, 0.3, m)
    family = rng.integers(6)
    if family == 1:
        A[m // 2 :] = A[: m - m // 2] * (1 + 1e-7)
        b[m // 2 :] = b[: m - m // 2]
    elif family == 2:
        A = A[:, :2] @ rng.normal(size=(2, n))
    elif family == 3:
        A[0], b[0] = 0.0, -0.1 if rng.random() < 0.7 else 0.2
    elif family == 4:
        A[0] = -A[-1] * rng.uniform(0.5, 2.0)
        b[0], b[-1] = 0.2, 0.2
    R = np.diag(rng.uniform(0.1, 1.0, n))
    if family == 5:
        M = rng.normal(size=(n, n))
        R = M @ M.T + 0.3 * np.eye(n)
    limit = rng.uniform(0.2, 2.0, n)
    return R, A, b, -limit * rng.uniform(0.2, 1.0, n), limit, rng.uniform(-2.5, 2.5, n)


def ours(module, R, A, b, low, high, u_nom):
    u = np.empty(len(u_nom))
    scale = np.ascontiguousarray(np.linalg.inv(np.linalg.cholesky(R)).T)
    result, iterations, active = module.solve_qp(scale, np.ascontiguousarray(A), b, low, high, u_nom, u)
    return result, u, active, iterations


def by_daqp(R, A, b, low, high, u_nom):
    n, m = len(u_nom), len(b)
    upper, lower = np.concatenate([high, np.full(m, 1e30)]), np.concatenate([low, b])
    x, _, flag, _ = daqp.solve(R, -R @ u_nom, np.ascontiguousarray(A), upper, lower, np.zeros(n + m, dtype=c_int))
    return flag == 1, x


def by_piqp(R, A, b, low, high, u_nom):
    solver = piqp.DenseSolver()
    solver.settings.eps_abs, solver.settings.eps_rel = 1e-10, 1e-11
    n = len(u_nom)
    solver.setup(R, -R @ u_nom, np.empty((0, n)), np.empty(0), A, b, np.full(len(b), 1e30), low, high)
    status = solver.solve()
    return status == piqp.PIQP_SOLVED, np.array(solver.result.x)


def cost(R, u, u_nom):
    return 0.5 * (u - u_nom) @ R @ (u - u_nom)


def agree(rng, *, with_piqp):
    R, A, b, low, high, u_nom = p = problem(rng)
    feasible, x = by_daqp(*p)
    result, u, _, _ = ours(_kernel64, *p)
    norm = np.maximum(np.linalg.norm(A, axis=1), 1e-9)
    gap = (A @ u - b) / norm
    if result != (0 if feasible else 1):
        assert near_the_edge(p), f"ours {result}, DAQP feasible {feasible}"
        return feasible
    if feasible:
        assert cost(R, u, u_nom) <= cost(R, x, u_nom) * (1 + 1e-6) + 1e-6  # DAQP accepts a violation of 1e-6
        assert gap[norm > 1e-9].min(initial=0.0) > -1e-8
        assert np.all(u >= low - 1e-9)
        assert np.all(u <= high + 1e-9)
        assert np.max(np.abs(u - x)) < 1e-5
        if with_piqp:
            solved, y = by_piqp(*p)
            assert not solved or np.max(np.abs(u - y)) < 1e-4
        result32, u32, _, _ = ours(_kernel, *p)
        if result32 == 0:
            gap32 = (A @ u32 - b) / norm
            assert gap32[norm > 1e-9].min(initial=0.0) > -1e-4
            assert cost(R, u32, u_nom) <= cost(R, x, u_nom) + 1e-3
        else:
            assert near_the_edge(p, 1e-3)
    return feasible


def near_the_edge(p, width=1e-6):
    """Whether feasibility changes when every row moves by `width`, so that both results are right."""
    R, A, b, low, high, u_nom = p
    norm = np.linalg.norm(A, axis=1)
    answers = {by_daqp(R, A, b + shift * norm, low, high, u_nom)[0] for shift in (-width, width)}
    return len(answers) == 2


@pytest.mark.parametrize("seed", range(4))
def test_agrees_with_two_solvers(seed):
    rng = np.random.default_rng(seed)
    feasible = [agree(rng, with_piqp=k % 10 == 0) for k in range(500)]
    assert 0.2 < np.mean(feasible) < 0.98


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100, 200))
def test_agrees_with_two_solvers_on_a_hundred_thousand(seed):
    rng = np.random.default_rng(seed)
    for k in range(1000):
        agree(rng, with_piqp=k % 10 == 0)


def test_solutions_satisfy_the_kkt_conditions():
    rng = np.random.default_rng(3)
    for _ in range(300):
        R, A, _, _, _, u_nom = p = problem(rng)
        result, u, active, _ = ours(_kernel64, *p)
        if result != 0:
            continue
        gradient = R @ (u - u_nom)
        n = len(u)
        for index, multiplier in active:
            assert multiplier > -1e-9
            if index < 2 * n:
                gradient[index % n] -= multiplier if index < n else -multiplier
            else:
                row = A[index - 2 * n]
                gradient -= multiplier * row / np.linalg.norm(row)
        np.testing.assert_allclose(gradient, 0.0, atol=1e-7)


def test_an_infeasible_problem_comes_with_a_farkas_certificate():
    rng = np.random.default_rng(5)
    seen = 0
    for _ in range(400):
        _, A, b, low, high, u_nom = p = problem(rng)
        result, _, active, _ = ours(_kernel64, *p)
        if result != 1 or not active:
            continue
        n, total, bound = len(u_nom), np.zeros(len(u_nom)), 0.0
        for index, weight in active:
            assert weight > -1e-9
            if index < n:
                total[index] += weight
                bound += weight * low[index]
            elif index < 2 * n:
                total[index - n] -= weight
                bound -= weight * high[index - n]
            else:
                norm = np.linalg.norm(A[index - 2 * n])
                total += weight * A[index - 2 * n] / norm
                bound += weight * b[index - 2 * n] / norm
        np.testing.assert_allclose(total, 0.0, atol=1e-6)  # the sum of normals vanishes, the sum of bounds does not
        assert bound > 0.0
        seen += 1
    assert seen > 20


def test_a_feasible_nominal_is_returned_bit_for_bit():
    rng = np.random.default_rng(11)
    for _ in range(200):
        R, A, _, low, high, _ = problem(rng)
        u_nom = rng.uniform(low, high)
        result, u, _, iterations = ours(_kernel64, R, A, A @ u_nom - 0.01, low, high, u_nom)
        assert (result, iterations) == (0, 0)
        assert np.array_equal(u, u_nom)
