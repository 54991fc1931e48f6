"""Comparison with other filters, run with dualbrain and a fake filter: results, targets, reference rows."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.peers.benchmarked_filters import BenchmarkedFilter
from benchmarks.peers.problems import scenes
from benchmarks.peers.problems.problem import barrier_rows, clearances, control_bounds
from benchmarks.peers.problems.qp_oracle import exact_optimum, piqp_optimum
from benchmarks.peers.processes.filter_process import FilterProcess, FilterUnavailableError
from benchmarks.peers.report import write_report
from benchmarks.peers.targets import evaluate_targets
from tests.support.run_once import run_once

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return run_once(tmp_path_factory, "quick_latency", quick)[1]


def quick(_):
    site = ["-S"] if sys.flags.no_site else []
    command = [sys.executable, *site, "-m", "benchmarks.filter_latency", "--quick", "--json"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True, env=os.environ, timeout=180)
    return (json.loads(done.stdout),)


def test_a_quick_run_prints_one_object_with_all_results(whole):
    assert {row["peer"] for row in whole["rows"]} == {"dualbrain", "dualbrain, in C", "fake"}
    for row in whole["rows"]:
        assert row["setting"] == "rows"
        assert row["n"] == 10
        assert 0.0 < row["median_us"] <= row["p99_us"] * 1.0001
        assert row["ratio"] > 0.0
    assert next(row for row in whole["rows"] if row["peer"] == "fake")["ratio"] > 2.0
    assert set(whole) >= {
        "versions",
        "infeasible",
        "clearance",
        "first_call",
        "deviation",
        "targets",
        "units",
        "refused",
    }
    assert whole["versions"]["fake"]["numpy"] == np.__version__


def test_dualbrain_is_exact_reports_infeasible_problems_and_keeps_its_clearance(whole):
    own, fake = whole["deviation"]
    assert own["max_on_own_rows"] < 1e-4
    assert own["worst_row_violation"] < 1e-5
    assert fake["worst_row_violation"] > 0.1
    assert all(one["finite"] and one["within_v_max"] and one["report"] != "silent" for one in whole["infeasible"])
    assert [one["feasible"] for one in whole["infeasible"]] == [False, False, None, None]
    assert all(one["h_min"] > 0.0 and one["no_answer"] == 0 for one in whole["clearance"])


def test_the_document_contains_every_filter(whole, tmp_path):
    write_report(whole, tmp_path / "peers.md")
    text = (tmp_path / "peers.md").read_text()
    assert text.count("fake") >= 4
    assert "## Targets" in text


@pytest.mark.parametrize(("setting", "n"), [("rows", 50), ("primitives", 10)])
def test_reference_rows_are_derivatives_and_two_solvers_agree(setting, n):
    problem = scenes.rows_problem(n) if setting == "rows" else scenes.primitives_problem(n)
    rng = np.random.default_rng(1)
    for _ in range(3):
        q = problem.home + rng.uniform(-0.1, 0.1, problem.n)
        A, b, _ = barrier_rows(problem, q)
        step = 1e-6 * np.eye(problem.n)
        slopes = [(clearances(problem, q + e) - clearances(problem, q - e)).ravel() / 2e-6 for e in step]
        assert np.max(np.abs(np.array(slopes).T - A)) < 1e-6
        u_nom = rng.uniform(-1.0, 1.0, problem.n) * problem.v_max
        lower, upper = control_bounds(problem, q)
        u = exact_optimum(A, b, lower, upper, u_nom)
        assert np.min(A @ u - b) > -1e-9
        assert np.max(np.abs(u - piqp_optimum(A, b, lower, upper, u_nom))) < 1e-6


def test_the_filter_changes_the_control_in_recorded_states():
    for n in (10, 100):
        problem = scenes.rows_problem(n)
        states, nominals, changed = scenes.record_states(problem, 300, hold=30)
        assert problem.n_pairs == n
        assert states.shape == nominals.shape == (300, problem.n)
        assert 0.1 < changed < 1.0
        assert min(float(np.min(clearances(problem, q))) for q in states) > 0.0


def test_targets_compare_with_the_fastest_peer_and_not_with_dualbrain():
    def row(peer, ratio, **more):
        base = {"peer": peer, "setting": "rows", "n": 10, "ratio": ratio, "ours": False, "shipped": False}
        return base | {"same_problem": True} | more

    found = evaluate_targets(
        [
            row("dualbrain", 1.0, ours=True),
            row("dualbrain, in C", 0.4, ours=True),
            row("quick", 14.0, same_problem=False),
            row("slow", 30.0, shipped=True),
        ]
    )
    reached = {one["target"]: (one["reached"], one["met"]) for one in found}
    assert reached["fastest peer, 10 rows"] == (14.0, False)
    assert reached["fastest peer with all rows, 10 rows"] == (30.0, True)
    assert reached["cbfpy with its defaults, 10 rows"] == (30.0, False)
    assert reached["Python over C, 10 rows"] == (2.5, True)


def test_an_unavailable_filter_states_the_reason():
    with pytest.raises(FilterUnavailableError, match="no environment"):
        FilterProcess(
            BenchmarkedFilter(name="missing", module="benchmarks.peers.filters.fake_filter", environment="missing")
        )
    with pytest.raises(FilterUnavailableError, match="ModuleNotFoundError"):
        FilterProcess(BenchmarkedFilter(name="missing", module="benchmarks.peers.no_such_module"))


def test_a_filter_that_hangs_is_terminated(tmp_path):
    problem = scenes.rows_problem(10)
    problem.save(str(tmp_path / "p.npz"))
    child = FilterProcess(BenchmarkedFilter(name="sleeper", module="benchmarks.peers.filters.fake_filter"))
    child.request("prepare", problem=str(tmp_path / "p.npz"), options={"delay": 30.0})
    with pytest.raises(FilterUnavailableError, match="no answer"):
        child.request("once", 0.2, q=problem.home.tolist(), u_nom=[0.0] * problem.n)
    child.close()
