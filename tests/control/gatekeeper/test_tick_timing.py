"""How ticks are timed: histograms against numpy, the laps of a tick, and the metronome's conditions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.control.gatekeeper.timing import tick_profile as laps_module
from dualbrain.control.gatekeeper.timing.histogram import N_BINS, Histogram
from dualbrain.control.gatekeeper.timing.tick_profile import TICK_PARTS, TickProfiler
from dualbrain.control.gatekeeper.timing.tick_timing import WARM_UP_TIME, TickTimer
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.timing import SIMULATED, simulated_timing

WIDTH = 1e-3


@given(st.lists(st.floats(0.0, 0.9), min_size=1), st.sampled_from((0.5, 0.99, 0.999)))
def test_a_quantile_is_that_of_the_values_to_within_a_bin(values, share):
    histogram = Histogram(WIDTH)
    for value in values:
        histogram.add(value)
    exact = np.quantile(values, share, method="inverted_cdf")
    assert exact - 1e-9 <= histogram.quantile(share) <= exact + WIDTH + 1e-9
    assert histogram.maximum == max(values)
    assert histogram.mean == pytest.approx(np.mean(values), abs=1e-9)
    assert sum(histogram.counts) == histogram.n_samples == len(values)


def test_what_is_beyond_the_last_bin_is_told_by_the_longest():
    histogram = Histogram(WIDTH)
    assert histogram.summary() == (0.0, 0.0, 0.0, 0.0)
    histogram.add(7.0)
    assert histogram.counts[N_BINS - 1] == 1
    assert histogram.summary() == (7.0, 7.0, 7.0, 7.0)


def test_each_part_of_a_tick_counts_once_and_the_parts_are_the_whole(monkeypatch):
    clock = iter(np.arange(0.0, 1.0, 1e-4).tolist())
    own = iter(np.arange(0.0, 1.0, 2e-5).tolist())
    monkeypatch.setattr(laps_module, "perf_counter", lambda: next(clock))
    monkeypatch.setattr(laps_module, "thread_time", lambda: next(own))
    laps = TickProfiler()
    laps.mark_part("door")
    laps.end_tick()
    for _ in range(3):
        for part in ("wait", "read", "wait", "read", "filter"):
            laps.mark_part(part)
        laps.end_tick()
    found = laps.summary()
    assert set(found) == set(TICK_PARTS)
    ticks = [found[part].ticks for part in ("wait", "filter", "skills", "door")]
    assert ticks == [3, 3, 0, 0], "what came before the first tick's end is nobody's"
    assert found["wait"].mean == pytest.approx(2e-4)
    assert found["filter"].mean == pytest.approx(1e-4)
    assert found["wait"].cpu[3] == pytest.approx(4e-5), "what other threads did meanwhile is not its own"
    assert sum(part.mean for part in found.values()) == pytest.approx(5e-4)


def test_a_part_without_a_name_is_a_mistake():
    with pytest.raises(KeyError):
        TickProfiler().mark_part("lunch")


def _beat(metronome, count, work, start=0.0, period=1e-3, lost=0):
    for k in range(count):
        now = start + k * period
        metronome.on_state(now, lost)
        metronome.on_command(now + 0.5 * work)
        metronome.ended(now + work)


@pytest.mark.parametrize("period", [1e-3, 0.02])
def test_a_punctual_tick_raises_nothing_and_a_late_one_is_counted_and_told(period):
    metronome, warm = TickTimer(simulated_timing(period)), round(WARM_UP_TIME / period)
    _beat(metronome, warm + 100, 0.3 * period, period=period)
    assert metronome.conditions() == 0
    late = (warm + 100) * period + 0.5
    _beat(metronome, 10, 1.5 * period, start=late, period=2.0 * period)
    flags = metronome.conditions()
    assert flags & Condition.TICK_OVERRUN
    assert not flags & Condition.COMMAND_LATE
    assert flags & Condition.TICK_LOST, "between the two there was a hole of half a second"
    found = metronome.summary()
    assert (found.late, found.ticks) == (10, warm + 110)
    assert found.interval[0] == pytest.approx(period, rel=0.03)
    assert sum(found.bins) == found.ticks - 1
    assert metronome.conditions() == 0, "told once"


@pytest.mark.parametrize("period", [1e-3, 0.02])
def test_a_fifth_of_the_last_second_late_is_too_much_and_is_forgotten_after_one(period):
    metronome, second = TickTimer(simulated_timing(period)), round(1.0 / period)
    _beat(metronome, 2 * second, 0.3 * period, period=period)
    _beat(metronome, second // 5, 1.1 * period, start=2.0, period=2.0 * period)
    assert not metronome.conditions() & Condition.TICKS_OVERRUN
    _beat(metronome, 1, 1.1 * period, start=2.6, period=period)
    assert metronome.conditions() & Condition.TICKS_OVERRUN
    _beat(metronome, second, 0.3 * period, start=3.0, period=period)
    metronome.conditions()
    _beat(metronome, 1, 0.3 * period, start=4.0, period=period)
    assert not metronome.conditions() & Condition.TICKS_OVERRUN


def test_states_that_never_came_are_counted_after_the_start():
    metronome, warm = TickTimer(SIMULATED), round(WARM_UP_TIME / SIMULATED.period)
    _beat(metronome, warm, 1e-4, lost=1)
    assert metronome.missed == 0
    _beat(metronome, 5, 1e-4, start=warm * 1e-3, lost=2)
    assert metronome.missed == 10
