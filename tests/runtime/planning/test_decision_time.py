"""The time of a decision: its parts add up over all shots, and the rest is the time that the planner did not report."""

import pytest

from dualbrain.contracts.verdict import Rejected
from dualbrain.records import Attempt, Proposal
from dualbrain.runtime.planning.planning_time import LATENCY_PARTS, decision_timings, format_timings, latency_breakdown


def attempt(gate=0.001, **timings):
    return Attempt(
        Proposal(text="", finish_reason="stop", planner="p", constrained_by="n", timings=timings),
        Rejected(stage="syntax", pointer="", got="", allowed="", hint="no"),
        gate,
    )


TWICE = (
    attempt(load=1.0, prefill=2.0, decode=3.0, prompt_tokens=500.0, total=6.5),
    attempt(prefill=0.5, decode=2.5, total=3.25),
)


def test_the_parts_add_up_to_the_decision():
    spent = decision_timings(TWICE, retrieval=0.25)
    assert spent["planner"] == 9.75
    assert spent["planner_prefill"] == 2.5
    assert spent["planner_rest"] == pytest.approx(9.75 - 1.0 - 2.5 - 5.5)
    assert "planner_prompt_tokens" not in spent
    assert sum(value for _, value in latency_breakdown(spent)) == pytest.approx(spent["decision"])
    assert spent["decision"] == pytest.approx(0.25 + 9.75 + 0.002)


def test_a_planner_that_reports_no_parts_has_only_a_rest():
    spent = decision_timings([attempt(total=4.0)], 0.0)
    assert {name for name in spent if name.startswith("planner_")} == {"planner_rest"}
    assert spent["planner_rest"] == 4.0
    assert decision_timings((), 0.5)["decision"] == 0.5


def test_one_line_for_people_names_every_part_that_took_time():
    line = format_timings(decision_timings(TWICE, 0.25))
    assert line.startswith("decided in 10.00 s: retrieval 0.25 s, load of the model 1.00 s, prefill 2.50 s")
    assert line.endswith("validation 2.0 ms")
    reused = attempt(total=0.04, reuse=0.04)
    parts = latency_breakdown(decision_timings((reused, *TWICE), 0.25))
    assert [label for label, _ in parts] == list(LATENCY_PARTS.values())
    assert dict(parts)["search for a contract of this place"] == 0.04
    assert format_timings({}) == ""
