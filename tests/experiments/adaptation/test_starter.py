"""The rule that chooses the planner of the demo, and its result on the committed log."""

import lzma
import re
from pathlib import Path

import msgspec
import pytest

from dualbrain.planner.registry import PACKAGED_PLANNER
from experiments.adaptation import starter
from experiments.adaptation.starter import LARGE_PLANNER, Starter, best_packaged_planner, rule_verdict

LOG = Path(starter.__file__).parents[1] / "logs" / "adaptation" / "starter.jsonl.xz"
MAKEFILE = Path(__file__).parents[3] / "Makefile"
NAMES = ("base-135m", "starter-135m")


def answer(right=True, kind="succeeded", seconds=1.0):
    """Score of an answer with one goal."""
    execution = {"kind": kind, "Delta": 0.001} if right else None
    parts = {"compliant": right, "skills": right, "named": right}
    return {**parts, "goals": 1, "declines": False, "decision_s": seconds, "flight": execution}


def rows_of(**answers):
    """Rows of the log: one list of answers per planner."""
    return [
        {"who": name.replace("_", "-"), "number": number, "answer": one}
        for name, some in answers.items()
        for number, one in enumerate(some)
    ]


@pytest.fixture(autouse=True)
def _two_packaged_planners(monkeypatch):
    monkeypatch.setattr(starter, "packaged_names", lambda: NAMES)


def test_the_planner_of_the_demo_is_that_of_the_committed_log():
    rows = [msgspec.json.decode(line) for line in lzma.decompress(LOG.read_bytes()).splitlines()]
    assert best_packaged_planner(rows) == PACKAGED_PLANNER
    assert re.search(rf"^PLANNER \?= {PACKAGED_PLANNER}$", MAKEFILE.read_text(encoding="utf-8"), re.MULTILINE)


def test_the_most_right_answers_decide():
    some = rows_of(base_135m=[answer(), answer(False)], starter_135m=[answer(), answer(seconds=9.0)])
    assert best_packaged_planner(some) == "starter-135m"


def test_ties_are_decided_by_successes_then_by_time():
    failing = rows_of(base_135m=[answer(kind="failed")] * 2, starter_135m=[answer(seconds=9.0), answer(kind="failed")])
    assert best_packaged_planner(failing) == "starter-135m"
    slower = rows_of(base_135m=[answer(seconds=2.0)], starter_135m=[answer(seconds=1.0)])
    assert best_packaged_planner(slower) == "starter-135m"


def test_only_common_questions_of_packaged_planners_count():
    some = rows_of(base_135m=[answer(False), answer(), answer()], starter_135m=[answer()])
    assert best_packaged_planner(some) == "starter-135m"
    assert best_packaged_planner(rows_of(base_135m=[answer()])) == ""
    assert "no result" in rule_verdict(rows_of(base_135m=[answer()]))


def test_the_large_model_is_compared_but_not_chosen():
    some = rows_of(base_135m=[answer(False)], starter_135m=[answer(False)])
    some += [{"who": LARGE_PLANNER, "number": 0, "answer": answer()}]
    assert best_packaged_planner(some) in NAMES
    assert LARGE_PLANNER in rule_verdict(some)
    assert any(line.startswith(f"| {LARGE_PLANNER} | 1 of 1") for line in Starter().report(some))


def test_the_report_counts_answers_executions_and_kinds_of_instructions():
    two_goals = answer() | {"goals": 2, "flight": {"kind": "succeeded", "Delta": 0.0}}
    wrong = answer(False) | {"goals": 2}
    text = "\n".join(
        Starter().report(rows_of(base_135m=[two_goals, wrong, two_goals], starter_135m=[wrong, wrong, two_goals]))
    )
    assert "| base-135m | 2 of 3" in text
    assert "| 2 of 2" in text
    assert "| base-135m | none yet | 2 of 3 (21%–94%) | none yet |" in text
    assert "By the rule **base-135m** is the planner of `make demo`" in text
    assert "minus starter-135m: +33% (95 % interval" in text
