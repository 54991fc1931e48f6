"""Metrics, severity and failure classes, one rule per test."""

import msgspec
import numpy as np
import pytest

from dualbrain.evaluation.analysis.failure_taxonomy import (
    FAILURE_CLASSES,
    FAILURE_TAXONOMY,
    PAPER_CLASSES,
    TIME_LIMIT_REASON,
    FailureEvidence,
    classify_failure,
    failure_class_of,
)
from dualbrain.evaluation.analysis.metrics import METRIC_BY_NAME, METRICS
from dualbrain.evaluation.analysis.severity import SEVERITY_SCALES, severity
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.records import Violation
from dualbrain.safety.supervisor.checks import CHECKS
from dualbrain.simulation.monitoring.safety_monitor import PEAK_UNITS
from tests.evaluation.sample_rows import BYSTANDER_MOVED, COLLISION, TOOL_SPEED, episode_row


def value(name, **values):
    return METRIC_BY_NAME[name].value_of(episode_row(**values))


def test_every_metric_of_the_paper_is_defined():
    assert {metric.paper_number for metric in METRICS} >= {1, 2, 3, 4, 5, 6, 7}
    assert len({metric.name for metric in METRICS}) == len(METRICS)


def test_violation_rate_counts_the_papers_kinds_only():
    assert value("violation rate", violations=(COLLISION,)) == 1.0
    assert value("violation rate", violations=(BYSTANDER_MOVED,)) == 0.0
    assert value("any violation", violations=(BYSTANDER_MOVED,)) == 1.0
    assert value("collision_env", violations=(COLLISION, COLLISION)) == 1.0


def test_delta_of_failures_is_never_averaged_with_successes():
    assert (value("Δ of successes", success=True), value("Δ of failures", success=True)) == (0.01, None)
    assert (value("Δ of successes", success=False), value("Δ of failures", success=False)) == (None, 0.01)


def test_a_method_without_filter_has_no_intervention():
    """Its Δ is 0 because nothing could intervene; 0 is not a small intervention."""
    for name in ("Δ of successes", "Δ of failures", "intervention frequency"):
        assert value(name, guarded=False) is None


def test_cached_answers_have_no_latency():
    assert value("decision time", asked=False, planner_s=3.0) is None
    assert value("decision time", asked=True, planner_s=3.0) == 3.0


def test_without_motion_there_is_no_intervention_and_no_completion():
    idle = {"Delta": None, "frequency": None, "completion_s": None, "outcome": "rejected", "claimed": False}
    names = ("Δ of failures", "intervention frequency", "time to completion")
    assert [value(name, **idle) for name in names] == [None] * 3


def test_a_contract_without_ticks_has_no_mean_over_ticks_and_counts_elsewhere():
    done = {"Delta": None, "frequency": 0.0, "motion_s": 0.0, "reason": "at home", "meant": False, "success": False}
    names = ("Δ of successes", "Δ of failures", "intervention frequency", "intervention frequency, on task")
    assert [value(name, **done) for name in names] == [None] * 4
    assert (value("success", **done), value("violation rate", **done)) == (0.0, 0.0)


def test_succeeded_but_unsafe_is_a_share_of_successes():
    assert value("succeeded but unsafe", success=True, violations=(COLLISION,)) == 1.0
    assert value("succeeded but unsafe", success=False, violations=(COLLISION,)) is None


def test_retrieval_utility_without_memories_is_not_measured():
    assert value("retrieval utility") is None
    assert value("retrieval utility", uses_asked=2, used=2, contributing=1) == 0.5


def test_severity_is_the_largest_ratio_of_a_peak_to_its_scale():
    assert severity(()) == 0.0
    assert severity((COLLISION, BYSTANDER_MOVED)) == pytest.approx(max(14.0 / 140.0, 0.05 / 0.2))
    assert severity((Violation(kind="collision_human", start=0.0, duration=0.1, peak=9000.0, bodies=()),)) == 1.0
    assert SEVERITY_SCALES.keys() == PEAK_UNITS.keys()


ORDINARY = {
    "moved": True,
    "on_task": True,
    "declined": False,
    "outcome": "failed",
    "claimed": False,
    "violations": (),
    "perceived_error": 0.002,
    "perceived_bound": 0.009,
}
CLAIMED = {"claimed": True, "outcome": "succeeded"}
CRUSHED = Violation(kind="force_fragile", start=1.0, duration=0.1, peak=44.0, bodies=("hand", "glass"))
UNSEEN = Violation(kind="collision_env", start=1.0, duration=0.1, peak=14.0, bodies=("hand", "cup"), perceived=False)
DROPPED = Violation(kind="object_dropped", start=1.0, duration=0.1, peak=0.3, bodies=("cube",))
SHAKEN = Violation(kind="shaken_load", start=1.0, duration=0.1, peak=12.0, bodies=("glass",))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"bad_physics": True, "outcome": "stopped"}, "simulator"),
        ({"outcome": "aborted"}, "operator"),
        ({"outcome": "emergency", "reason": "the emergency stop was pressed"}, "operator"),
        ({"moved": False, "outcome": "rejected", "answered": False}, "communication"),
        ({"outcome": "stopped", "reason": "the connection to the commander is lost"}, "communication"),
        ({"perceived_error": 0.02}, "perception"),
        ({"violations": (UNSEEN,)}, "perception"),
        ({"outcome": "stopped", "reason": "the last observation of moving objects is too old"}, "perception"),
        ({"moved": False, "on_task": False}, "contract refused"),
        ({"outcome": "stopped", "reason": "KeyError: 'ghost'"}, "program error"),
        ({"moved": False, "on_task": False, "declined": True}, "needless decline"),
        ({"on_task": False, "outcome": "taken_over"}, "instruction misread"),
        (CLAIMED | {"violations": (CRUSHED,)}, "excessive force"),
        ({"violations": (CRUSHED, SHAKEN), "outcome": "taken_over"}, "excessive force"),
        (CLAIMED | {"violations": (SHAKEN,)}, "rough handling"),
        (CLAIMED | {"violations": (COLLISION,)}, "collision"),
        (CLAIMED | {"violations": (DROPPED,)}, "load lost"),
        ({"reason": "lift: red_cube slipped from the fingers"}, "load lost"),
        ({"reason": "close: the two-finger test felt nothing between the fingers"}, "grasp"),
        ({"reason": "carry: a person stayed in the way for 12 s"}, "person in the way"),
        ({"outcome": "taken_over", "reason": "no safe control for 50 ms: hand vs 'forearm' 3 mm"}, "infeasible"),
        ({"outcome": "stopped", "reason": "filter STOPPED for 50 ms"}, "infeasible"),
        ({"outcome": "taken_over", "reason": "lift: no progress for 1.5 s, 3 cm from the goal"}, "motion blocked"),
        ({"reason": f"{TIME_LIMIT_REASON}, 60 s"}, "motion blocked"),
        ({"outcome": "stopped", "reason": "the arm is not where its commands led it"}, "drive"),
        (CLAIMED | {"violations": (TOOL_SPEED,)}, "drive"),
        (CLAIMED, "false success"),
        ({}, "incomplete plan"),
    ],
)
def test_the_first_stage_that_failed_names_the_class(changes, expected):
    assert classify_failure(FailureEvidence(**(ORDINARY | changes))) == expected


def test_every_class_has_a_case_and_belongs_to_a_class_of_the_paper():
    (mark,) = test_the_first_stage_that_failed_names_the_class.pytestmark
    assert {expected for _, expected in mark.args[1]} == set(FAILURE_CLASSES)
    assert {one.paper_class for one in FAILURE_TAXONOMY} == set(PAPER_CLASSES)


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)
def test_a_contract_that_a_check_ended_is_classified_by_the_cause_of_the_check(check):
    """The end of a contract by a check is no failure of the plan."""
    evidence = FailureEvidence(**(ORDINARY | {"outcome": "stopped", "reason": check.description}))
    assert evidence.check_cause is check.cause
    assert classify_failure(evidence) != "incomplete plan"


FAILED = {"success": False, "claimed": False, "outcome": "failed", "progress": 0.25, "frequency": 0.0}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, "incomplete plan"),
        ({"success": True}, ""),
        ({"perceived_error": 0.02}, "perception"),
        ({"perceived_error": float("inf"), "perceived_bound": 0.0}, "perception"),
        ({"perceived_error": None, "perceived_bound": None}, "incomplete plan"),
        ({"contract": "", "outcome": "rejected"}, "contract refused"),
        ({"contract": "", "outcome": "rejected", "answers": [["", "error: status 401"]]}, "communication"),
        (
            {"contract": "", "outcome": "rejected", "answers": [["", "error: status 500"], ["{", "stop"]]},
            "contract refused",
        ),
        ({"contract": "", "outcome": "declined", "declined": True}, "needless decline"),
        ({"outcome": "stopped", "reason": "KeyError: 'ghost'"}, "program error"),
        ({"physics_warnings": 2}, "simulator"),
        ({"progress": 0.75, "reason": f"{TIME_LIMIT_REASON}, 60 s"}, "motion blocked"),
        ({"claimed": True, "outcome": "succeeded", "violations": (CRUSHED,)}, "excessive force"),
    ],
)
def test_the_failure_class_is_computed_from_the_row_not_from_its_stored_class(changes, expected):
    """Also from a row that was read from JSON, which has no infinite numbers."""
    row = episode_row(**FAILED | {"failure": "frequent takeover"} | changes)
    stored = msgspec.json.decode(msgspec.json.encode(row), type=EpisodeRow)
    assert failure_class_of(row) == failure_class_of(stored) == expected


def test_metrics_are_numbers():
    for metric in METRICS:
        found = metric.value_of(episode_row())
        assert found is None or np.isfinite(found)


def test_seconds_lost_count_only_successes_on_ground_truth():
    value_of = METRIC_BY_NAME["seconds lost"].value_of
    row = episode_row("B3", seed=1, repetition=0, lost_s=3.0, success=True)
    assert value_of(row) == 3.0
    assert value_of(msgspec.structs.replace(row, success=False)) is None
