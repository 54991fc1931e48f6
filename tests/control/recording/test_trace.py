"""The trace: rows are returned unchanged for any length, and Δ follows its definition."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import BLOCK_ROWS, Trace, columns, spans
from dualbrain.errors import UnknownNameError
from dualbrain.robots.interface import RobotState
from tests.control.recording.sample_ticks import FakeFilterResult, append_ticks

ZEROS = np.zeros(2)


def make_trace(deltas: list[float], h: list[float], actions: list[int]) -> Trace:
    trace = Trace(2)
    for k, (delta, h_min, action) in enumerate(zip(deltas, h, actions, strict=True)):
        state = RobotState(stamp=k * 1e-3, sequence=k, q=ZEROS, v=ZEROS, opening=0.0, finger_forces=(0.0, 0.0))
        trace.append(
            k * 1e-3, state, ZEROS, FakeFilterResult(ZEROS, delta=delta, h_min=h_min), action=action, phase="x"
        )
    return trace


def test_columns_tile_the_row() -> None:
    covered = [k for where in columns(7).values() for k in range(where.start, where.stop)]
    assert covered == list(range(len(covered)))


def test_rows_remain_valid_while_the_trace_grows() -> None:
    trace = Trace(7)
    returned_rows = append_ticks(trace, 2 * BLOCK_ROWS + 5)
    assert len(trace) == 2 * BLOCK_ROWS + 5
    assert np.array_equal(np.stack(returned_rows), trace.rows)
    assert np.array_equal(trace["sequence"], np.arange(len(trace)))
    assert trace["q"].shape == trace["u"].shape == (len(trace), 7)
    assert np.array_equal(trace["v"], -trace["q"])
    assert np.array_equal(trace["u"].astype(np.float32), trace["u_nom"].astype(np.float32))
    assert trace["forces"][:, 1].tolist() == [1.0] * len(trace)
    assert np.all(trace["drive"] == 1)
    assert np.all(trace["n_rows"] == 90)


def test_a_column_is_the_same_with_and_without_all_rows() -> None:
    trace = Trace(7)
    append_ticks(trace, BLOCK_ROWS + 10)
    before = {name: trace[name] for name in trace.columns}
    rows = trace.rows
    for name, where in trace.columns.items():
        expected = rows[:, where] if where.stop - where.start > 1 else rows[:, where.start]
        np.testing.assert_array_equal(before[name], expected)
        np.testing.assert_array_equal(trace[name], expected)


def test_extend_continues_a_trace() -> None:
    whole, parts = Trace(7), Trace(7)
    append_ticks(whole, 300)
    parts.extend(whole.rows[:100])
    parts.extend(whole.rows[100:])
    assert np.array_equal(parts.rows, whole.rows)
    append_ticks(parts, 2)
    assert len(parts) == 302


TICKS = st.lists(st.tuples(st.floats(0, 2), st.floats(-0.1, 1.0), st.integers(0, 3)), min_size=1, max_size=60)


@given(TICKS)
def test_summary_is_the_definition(ticks: list[tuple[float, float, int]]) -> None:
    trace = make_trace(*map(list, zip(*ticks, strict=True)))
    whole = trace.summary(dead_band=0.5)
    deltas = [delta for delta, _, _ in ticks]
    assert whole.Delta == pytest.approx(sum(deltas) / len(deltas))
    assert whole.delta_peak == max(deltas)
    assert whole.h_min == min(h for _, h, _ in ticks)
    assert whole.intervention_frequency == pytest.approx(sum(delta > 0.5 for delta in deltas) / len(deltas))
    parts = [trace.summary(action) for action in range(4)]
    assert sum(part.ticks for part in parts) == len(ticks)
    assert sum(part.Delta_sum for part in parts) == pytest.approx(whole.Delta_sum)


def test_an_empty_trace_has_no_intervention() -> None:
    summary = Trace(7).summary()
    assert (summary.ticks, summary.Delta, summary.h_min) == (0, None, None)
    assert Trace(7).interventions() == []


def test_a_value_that_was_not_computed_counts_as_unsafe() -> None:
    summary = make_trace([np.nan, 0.0], [0.1, np.nan], [0, 0]).summary()
    assert summary.Delta == 1.0
    assert summary.h_min == -np.inf


@given(st.lists(st.integers(0, 2), max_size=40))
def test_spans_cover_every_tick_once(codes: list[int]) -> None:
    found = spans(np.array(codes, float), np.arange(len(codes)) * 0.1)
    assert [code for span in found for code in [span.code] * (span.last - span.first + 1)] == codes
    assert all(a.end == b.start and a.code != b.code for a, b in pairwise(found))


def test_the_outcome_of_a_contract_counts_values_that_were_not_computed() -> None:
    outcome = FlightLog(make_trace([np.nan, 0.0], [np.nan, np.nan], [0, 0])).outcome("failed", "", 0, ())
    assert (outcome.Delta, outcome.delta_peak, outcome.intervention_frequency, outcome.h_min) == (1.0, 2.0, 0.5, None)


def test_interventions_are_above_the_dead_band() -> None:
    trace = make_trace([0.0, 5e-5, 0.2, 0.3, 0.0, 0.4], [0.1] * 6, [0] * 6)
    assert [(span.first, span.last) for span in trace.interventions()] == [(2, 3), (5, 5)]


def test_an_unknown_column_names_the_known_ones() -> None:
    with pytest.raises(UnknownNameError, match="u_nom"):
        Trace(2)["u_nomm"]
