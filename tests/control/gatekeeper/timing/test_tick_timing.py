"""Timing of ticks: histograms against numpy, the parts of a tick, and the conditions of the tick timer."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from dualbrain.control.gatekeeper.timing import tick_profile as tick_profile_module
from dualbrain.control.gatekeeper.timing.histogram import N_BINS, Histogram
from dualbrain.control.gatekeeper.timing.tick_profile import TICK_PARTS, TickProfiler
from dualbrain.control.gatekeeper.timing.tick_timing import WARM_UP_TIME, TickTimer
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.timing import SIMULATED, simulated_timing

WIDTH = 1e-3


@given(st.lists(st.floats(0.0, 0.9), min_size=1), st.sampled_from((0.5, 0.99, 0.999)))
def test_a_quantile_is_that_of_the_values_to_within_a_bin(values, fraction):
    histogram = Histogram(WIDTH)
    for value in values:
        histogram.add(value)
    exact = np.quantile(values, fraction, method="inverted_cdf")
    assert exact - 1e-9 <= histogram.quantile(fraction) <= exact + WIDTH + 1e-9
    assert histogram.maximum == max(values)
    assert histogram.mean == pytest.approx(np.mean(values), abs=1e-9)
    assert sum(histogram.counts) == histogram.n_samples == len(values)


@given(st.lists(st.floats(0.0, 5e-3) | st.floats(0.9, 2.0), max_size=50))
@example([1.0, 1.5])
def test_many_values_count_as_if_added_one_by_one(values):
    one_by_one, together = Histogram(WIDTH), Histogram(WIDTH)
    for value in values:
        one_by_one.add(value)
    together.add_all(np.array(values))
    assert (together.counts, together.n_samples, together.maximum) == (
        one_by_one.counts,
        one_by_one.n_samples,
        one_by_one.maximum,
    )
    assert together.sum == pytest.approx(one_by_one.sum)


def test_values_beyond_the_last_bin_are_reported_by_the_maximum():
    histogram = Histogram(WIDTH)
    assert histogram.summary() == (0.0, 0.0, 0.0, 0.0)
    histogram.add(7.0)
    assert histogram.counts[N_BINS - 1] == 1
    assert histogram.summary() == (7.0, 7.0, 7.0, 7.0)


def test_each_part_of_a_tick_counts_once_and_the_parts_add_up_to_the_tick(monkeypatch):
    clock = iter(np.arange(0.0, 1.0, 1e-4).tolist())
    cpu_clock = iter(np.arange(0.0, 1.0, 2e-5).tolist())
    monkeypatch.setattr(tick_profile_module, "perf_counter", lambda: next(clock))
    monkeypatch.setattr(tick_profile_module, "thread_time", lambda: next(cpu_clock))
    profiler = TickProfiler()
    profiler.mark_part("door")
    profiler.end_tick()
    for _ in range(3):
        for part in ("wait", "read", "wait", "read", "filter"):
            profiler.mark_part(part)
        profiler.end_tick()
    found = profiler.summary()
    assert set(found) == set(TICK_PARTS)
    ticks = [found[part].ticks for part in ("wait", "filter", "skills", "door")]
    assert ticks == [3, 3, 0, 0], "the time before the first end of a tick is not counted"
    assert found["wait"].mean == pytest.approx(2e-4)
    assert found["filter"].mean == pytest.approx(1e-4)
    assert found["wait"].cpu[3] == pytest.approx(4e-5), "the time of other threads is not counted"
    assert sum(part.mean for part in found.values()) == pytest.approx(5e-4)


def test_an_unknown_part_raises():
    with pytest.raises(KeyError):
        TickProfiler().mark_part("lunch")


def run_ticks(timer, count, work, start=0.0, period=1e-3, lost=0):
    for k in range(count):
        now = start + k * period
        timer.on_state(now, lost)
        timer.on_command(now + 0.5 * work)
        timer.on_tick_end(now + work)


@pytest.mark.parametrize("period", [1e-3, 0.02])
def test_a_punctual_tick_causes_no_condition_and_a_late_one_is_counted_and_reported(period):
    timer, warm = TickTimer(simulated_timing(period)), round(WARM_UP_TIME / period)
    run_ticks(timer, warm + 100, 0.3 * period, period=period)
    assert timer.conditions() == 0
    late = (warm + 100) * period + 0.5
    run_ticks(timer, 10, 1.5 * period, start=late, period=2.0 * period)
    flags = timer.conditions()
    assert flags & Condition.TICK_OVERRUN
    assert not flags & Condition.COMMAND_LATE
    assert flags & Condition.TICK_LOST, "there is a gap of half a second between the two runs"
    found = timer.summary()
    assert (found.late, found.ticks) == (10, warm + 110)
    assert found.interval[0] == pytest.approx(period, rel=0.03)
    assert sum(found.bins) == found.ticks - 1
    assert timer.conditions() == 0, "a condition is reported once"


@pytest.mark.parametrize("period", [1e-3, 0.02])
def test_more_than_a_fifth_of_late_ticks_within_a_second_is_a_condition(period):
    timer, second = TickTimer(simulated_timing(period)), round(1.0 / period)
    run_ticks(timer, 2 * second, 0.3 * period, period=period)
    run_ticks(timer, second // 5, 1.1 * period, start=2.0, period=2.0 * period)
    assert not timer.conditions() & Condition.TICKS_OVERRUN
    run_ticks(timer, 1, 1.1 * period, start=2.6, period=period)
    assert timer.conditions() & Condition.TICKS_OVERRUN
    run_ticks(timer, second, 0.3 * period, start=3.0, period=period)
    timer.conditions()
    run_ticks(timer, 1, 0.3 * period, start=4.0, period=period)
    assert not timer.conditions() & Condition.TICKS_OVERRUN


def test_missed_states_are_counted_after_the_warm_up():
    timer, warm = TickTimer(SIMULATED), round(WARM_UP_TIME / SIMULATED.period)
    run_ticks(timer, warm, 1e-4, lost=1)
    assert timer.missed == 0
    run_ticks(timer, 5, 1e-4, start=warm * 1e-3, lost=2)
    assert timer.missed == 10
