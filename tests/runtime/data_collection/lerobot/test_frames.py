"""Frames: the nearest tick to each frame time, and every tick in the interval of exactly one frame."""

from pathlib import Path

import numpy as np
import pytest

from dualbrain.control.recording.trace import DEAD_BAND, FULL_INTERVENTION
from dualbrain.errors import ConfigurationError
from dualbrain.runtime.data_collection.lerobot.frames import MAX_DISTANCE, nearest_ticks, sample_frames
from tests.runtime.data_collection.lerobot.sample_runs import PERIOD, sample_rows, sample_trace

PATH = Path("a.mcap")


def frames_of(rows, fps=30, action="velocity", robot="panda"):
    return sample_frames(sample_trace(rows, robot), fps, action=action, period=PERIOD, path=PATH)


@pytest.mark.parametrize("fps", [1, 7, 30, 50, 60, 333, 1000])
@pytest.mark.parametrize("ticks", [1, 2, 34, 35, 1001])
def test_the_tick_of_a_frame_is_the_nearest_one(fps, ticks):
    t = 5.0 + PERIOD * np.arange(ticks)
    chosen = nearest_ticks(t, fps)
    times = np.arange(len(chosen)) / fps
    distances = np.abs((t - t[0])[:, None] - times[None, :])
    assert np.abs(distances[chosen, np.arange(len(chosen))] - distances.min(axis=0)).max() < 1e-9
    assert times[-1] <= t[-1] - t[0] + 1e-6 < times[-1] + 1 / fps + 2e-6
    assert (np.diff(chosen) > 0).all()


def test_of_two_equally_near_ticks_the_earlier_one_is_taken():
    assert nearest_ticks(np.array([0.0, 0.25, 0.75, 1.0]), 2).tolist() == [0, 1, 3]


@pytest.mark.parametrize("fps", [30, 200, 1000])
def test_values_of_the_tick_are_kept_and_those_of_its_interval_aggregated(fps):
    rows = sample_rows(ticks=500)
    trace, frames = sample_trace(rows), frames_of(rows, fps)
    chosen = nearest_ticks(trace["t"], fps)
    for k, first in enumerate(chosen):
        end = chosen[k + 1] if k + 1 < len(chosen) else len(trace)
        assert np.array_equal(frames.action[k], trace["u"][first])  # recorded in single precision: bit for bit
        assert np.array_equal(frames.q[k], trace["q"][first].astype(np.float32))
        assert np.array_equal(frames.u_nom[k], trace["u_nom"][first].astype(np.float32))
        delta = trace["delta"][first:end].max()
        assert frames.delta[k] == np.float32(delta)
        assert frames.h_min[k] == np.float32(trace["h_min"][first:end].min())
        assert frames.status[k] == trace["status"][first:end].max()
        assert frames.intervention[k] == (delta > DEAD_BAND)
    assert len(frames) == len(chosen)


@pytest.mark.parametrize("tick", [0, 32, 33, 34, 198, 199])
def test_an_intervention_of_one_tick_marks_one_frame(tick):
    delta = np.zeros(200)
    delta[tick] = 0.5
    frames = frames_of(sample_rows(delta=delta))
    assert frames.intervention.sum() == (frames.delta == 0.5).sum() == 1


def test_a_difference_within_the_dead_band_is_no_intervention():
    assert not frames_of(sample_rows(delta=np.full(200, DEAD_BAND))).intervention.any()


def test_the_position_action_is_the_executed_control_integrated_until_the_next_frame():
    rows = sample_rows(ticks=301)
    trace, frames = sample_trace(rows), frames_of(rows, 50, "position")
    chosen = [*nearest_ticks(trace["t"], 50), len(trace)]
    for k in range(len(frames)):
        moved = PERIOD * trace["u"][chosen[k] : chosen[k + 1]].sum(axis=0)
        assert np.allclose(frames.action[k], trace["q"][chosen[k]] + moved, rtol=0.0, atol=1e-6)


def test_values_that_were_not_computed_count_as_the_worst():
    values = np.full(200, np.nan)
    frames = frames_of(sample_rows(delta=values, h_min=values))
    assert (frames.delta == FULL_INTERVENTION).all()
    assert (frames.h_min == -MAX_DISTANCE).all()
    assert frames.intervention.all()


@pytest.mark.parametrize("name", ["q", "v", "u", "u_nom", "t", "status"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_value_that_is_not_finite_is_reported_with_its_tick(name, value):
    rows = sample_rows()
    rows[7, sample_trace(rows).columns[name].start] = value
    with pytest.raises(ConfigurationError, match=rf"a value of {name} that is not finite, at tick 7\. Leave this run"):
        frames_of(rows)


def test_times_and_rates_are_checked():
    t = PERIOD * np.arange(200)
    with pytest.raises(ConfigurationError, match="--fps: got 2000, allowed: 1 to 1000, the rate of the ticks"):
        frames_of(sample_rows(), 2000)
    with pytest.raises(ConfigurationError, match="time does not increase after tick 4"):
        frames_of(sample_rows(t=np.where(np.arange(200) == 5, t[4], t)))
    with pytest.raises(ConfigurationError, match=r"gap from 0\.099 s to 0\.200 s\. Leave this run out, or choose"):
        frames_of(sample_rows(t=t + 0.1 * (np.arange(200) >= 100)))
    with pytest.raises(ConfigurationError, match="a status that is not 0 to 4"):
        frames_of(sample_rows(status=np.full(200, 5)))
