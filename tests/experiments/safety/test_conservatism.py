"""The tasks of experiment `conservatism`, its counting, and one task."""

from collections import Counter
from itertools import islice

import pytest

from dualbrain.core.storage.jsonl_log import JsonlLog
from dualbrain.simulation.scenes.generators.tabletop import LEVEL_I_FAMILIES
from experiments.engine.experiment import Options
from experiments.planning.competent_contracts import CLEARANCE_BY_HEIGHT, GRIP_FORCE, make_task, task_parameters
from experiments.safety.conservatism import N_FEASIBLE_TASKS, Conservatism

FAST = {"family": "tabletop", "seed": 106, "kind": "move_to"}


def row_of(key, feasible, *, on=True):
    """A row as the experiment would log it."""
    family, rest = key.split(":")
    seed, kind = rest.split()
    off = {"valid": True, "outcome": "succeeded", "truth": feasible, "violations": [], "duration": 10.0, "reason": ""}
    on_row = {**off, "truth": on, "duration": 10.5, "reason": "carry: stuck, 1.5 cm from the goal", "bound": "carry: x"}
    return {
        "key": key,
        "family": family,
        "seed": int(seed),
        "kind": kind,
        "feasible": feasible,
        "off": off,
        "on": on_row if feasible else None,
    }


@pytest.fixture
def options(tmp_path):
    return Options(tmp_path, "")


def test_every_family_and_kind_takes_part():
    tasks = list(islice(task_parameters(), N_FEASIBLE_TASKS))
    assert set(Counter(one["family"] for one in tasks).values()) <= {28, 29}
    assert {one["family"] for one in tasks} == set(LEVEL_I_FAMILIES)
    kinds = Counter(one["kind"] for one in tasks)
    assert kinds["errand"] > N_FEASIBLE_TASKS * 0.45
    assert min(kinds.values()) > N_FEASIBLE_TASKS * 0.1


@pytest.mark.parametrize("family", LEVEL_I_FAMILIES)
def test_a_contract_follows_the_rules_of_the_prompt_and_its_seed(family):
    for seed in range(100, 103):
        first, second = (make_task(family, seed, "errand") for _ in range(2))
        assert first.actions == second.actions
        grasp, place = (action["params"] for action in first.actions)
        assert grasp["clearance"] in {*CLEARANCE_BY_HEIGHT.values(), 0.1}
        assert place["wait"] == ("until_clear" if family == "forearm" else "none")
        assert grasp["force"] == GRIP_FORCE


def test_each_infeasible_task_adds_one_unit(options):
    experiment = Conservatism()
    first = [unit.key for unit in experiment.units(options)]
    assert len(first) == N_FEASIBLE_TASKS
    log = JsonlLog(options.folder / "conservatism.jsonl")
    log.append(row_of(first[0], feasible=False))
    log.append(row_of(first[1], feasible=True))
    more = [unit.key for unit in experiment.units(options)]
    assert more[:N_FEASIBLE_TASKS] == first
    assert len(more) == N_FEASIBLE_TASKS + 1


def test_the_report_counts_the_tasks_that_the_filter_made_fail(options):
    keys = [unit.key for unit in Conservatism().units(options)][:4]
    rows = [row_of(keys[0], feasible=False), *(row_of(key, feasible=True, on=key != keys[2]) for key in keys[1:])]
    text = "\n".join(Conservatism().report(rows))
    assert "**1 of 3" in text
    assert "median 0.50 s" in text
    assert f"| {keys[2]} | carry: stuck, 1.5 cm from the goal | 1.5 cm | carry: x |" in text


def test_a_motion_runs_without_and_with_the_filter():
    row = Conservatism().run(FAST)
    assert row["feasible"]
    assert row["on"]["truth"]
    assert row["on"]["h_min"] > 0.0
    assert row["off"]["Delta"] == 0.0
