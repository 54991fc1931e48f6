"""Commander failure: the units, the report, and one episode of some failures."""

from collections import Counter

import pytest

from dualbrain.evaluation.fault_injection.faults import MOMENTS
from experiments.engine.experiment import Options
from experiments.gatekeeper.commander_failure import DECLARED_LIMITS, FAILURE_MODES, CommanderFailure


def result(how="kill", moment="carrying", **changes):
    ledger = {"stored": 10, "missing": 0, "fault": ""}
    default = {
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
    return {**default, **changes}


def test_units_cover_each_failure_and_moment_in_each_prefix(tmp_path):
    parameters = [unit.parameters for unit in CommanderFailure().units(Options(tmp_path, "some-planner"))]
    loop, thread = ([one for one in parameters if one.get("thread", False) is used] for used in (False, True))
    for some, repeats in ((loop, 4), (thread, 2)):
        cells = Counter((one["how"], one["moment"]) for one in some)
        assert set(cells.values()) == {repeats}
        assert len(cells) == len(FAILURE_MODES) * len(MOMENTS)
        assert {one["moment"] for one in some[: len(cells)]} == set(MOMENTS)
    assert set(DECLARED_LIMITS) == set(FAILURE_MODES)


def test_late_missing_and_lost_results_are_counted_and_listed():
    rows = [
        result(),
        result(took=DECLARED_LIMITS["kill"] + 0.01),
        result(took=None, moment="closing"),
        result(early=True, took=9.0),
        result("stop", ledger={"stored": 5, "missing": 2, "fault": "x"}, next="not let in"),
        result(unsafe=[{"kind": "c"}]),
        result("flood", thread=True),
    ]
    text = "\n".join(CommanderFailure().report(rows))
    assert "| kill | 4 | 250 ms | 100 ms | 257 ms | 260 ms | 2 | 1 | succeeded 4 |" in text
    assert "| stop | 1 | 550 ms | 100 ms | 100 ms | 100 ms | 0 | 0 | not let in 1 |" in text
    assert "| flood, control thread | 1 | 750 ms | 100 ms |" in text
    assert "**6 of 7 (49%–97%)**; 2 of 65 acknowledged episodes lost" in text
    assert "Not counted: 1 in which the arm was held before the failure" in text
    assert "| closing | never |" in text
    assert text.count("\n- ") == 4


@pytest.mark.slow
@pytest.mark.parametrize(("how", "moment"), [("kill", "closing"), ("gatekeeper", MOMENTS[-1]), ("flood", "closing")])
def test_one_episode_is_safe_and_loses_nothing(how, moment):
    row = CommanderFailure().run({"how": how, "moment": moment, "seed": 1})
    assert row["took"] is not None
    assert row["unsafe"] == []
    assert row["next"] == "succeeded"
    assert row["ledger"]["missing"] == 0
    assert row["ledger"]["fault"] == ""
    assert row["ledger"]["stored"] > 0
