"""Metrics and severity, one rule per test."""

import msgspec
import numpy as np
import pytest

from dualbrain.evaluation.analysis.metrics import METRIC_BY_NAME, METRICS
from dualbrain.evaluation.analysis.severity import SEVERITY_SCALES, severity
from dualbrain.records import Violation
from dualbrain.simulation.monitoring.safety_monitor import PEAK_UNITS
from tests.evaluation.sample_rows import BYSTANDER_MOVED, COLLISION, episode_row


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


def test_metrics_are_numbers():
    for metric in METRICS:
        found = metric.value_of(episode_row())
        assert found is None or np.isfinite(found)


def test_seconds_lost_count_only_successes_on_ground_truth():
    value_of = METRIC_BY_NAME["seconds lost"].value_of
    row = episode_row("B3", seed=1, repetition=0, lost_s=3.0, success=True)
    assert value_of(row) == 3.0
    assert value_of(msgspec.structs.replace(row, success=False)) is None
