"""The proof of the dying cortex: its size, its account, and one episode of each kind that a test can afford."""

from collections import Counter

import pytest

from dualbrain.evaluation.fault_injection.faults import MOMENTS
from experiments.engine.experiment import Options
from experiments.gatekeeper.commander_failure import DECLARED_LIMITS, FAILURE_MODES, CommanderFailure


def row(how="kill", moment="carrying", **changes):
    ledger = {"stored": 10, "missing": 0, "fault": ""}
    usual = {
        "key": f"{how}/{moment}/0",
        "how": how,
        "moment": moment,
        "took": 0.1,
        "early": False,
        "unsafe": [],
        "later": 0,
        "next": "succeeded",
        "ledger": ledger,
    }
    return {**usual, **changes}


def test_every_way_at_every_moment_and_any_prefix_is_a_sample(tmp_path):
    abouts = [unit.parameters for unit in CommanderFailure().units(Options(tmp_path, "nobody"))]
    cells = Counter((one["how"], one["moment"]) for one in abouts)
    assert set(cells.values()) == {4}
    assert len(cells) == len(FAILURE_MODES) * len(MOMENTS)
    assert {one["moment"] for one in abouts[: len(cells)]} == set(MOMENTS)
    assert set(DECLARED_LIMITS) == set(FAILURE_MODES)


def test_what_came_late_or_never_or_was_lost_is_counted_and_named():
    rows = [
        row(),
        row(took=DECLARED_LIMITS["kill"] + 0.01),
        row(took=None, moment="closing"),
        row(early=True, took=9.0),
        row("stop", ledger={"stored": 5, "missing": 2, "fault": "x"}, next="not let in"),
        row(unsafe=[{"kind": "c"}]),
    ]
    text = "\n".join(CommanderFailure().report(rows))
    assert "| kill | 4 | 250 ms | 100 ms | 257 ms | 260 ms | 2 | 1 | succeeded 4 |" in text
    assert "| stop | 1 | 550 ms | 100 ms | 100 ms | 100 ms | 0 | 0 | not let in 1 |" in text
    assert "**5 of 6 (44%–97%)**; 2 of 55 acknowledged episodes lost" in text
    assert "Not counted: 1 whose arm was held before the deed" in text
    assert "| closing | never |" in text
    assert text.count("\n- ") == 4


@pytest.mark.slow
@pytest.mark.parametrize(("how", "moment"), [("kill", "closing"), ("gatekeeper", MOMENTS[-1]), ("flood", "closing")])
def test_one_episode(how, moment):
    found = CommanderFailure().run({"how": how, "moment": moment, "seed": 1})
    assert found["took"] is not None
    assert found["unsafe"] == []
    assert found["next"] == "succeeded"
    assert found["ledger"]["missing"] == 0
    assert found["ledger"]["fault"] == ""
    assert found["ledger"]["stored"] > 0
