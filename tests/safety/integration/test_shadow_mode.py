"""Shadow mode: it changes nothing, reports what the filter would have done, and its log survives a crash."""

import json
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace, Pose, Sphere
from dualbrain.errors import ConfigurationError
from dualbrain.safety.cbf.filter import FilterStatus, Obstacle, SafetyFilter
from dualbrain.safety.integration.intervention_log import InterventionInterval, InterventionLog, read_intervention_log
from dualbrain.safety.integration.shadow_mode import DEAD_BAND, ShadowFilter
from tests.safety import random_scenes

TABLE = Obstacle("table", HalfSpace(), Pose((0.0, 0.0, 0.0)))
SHELF = Obstacle("shelf", Box((0.2, 0.2, 0.01)), Pose((0.5, -0.1, 0.22)))
POST = Obstacle("post", Capsule(0.03, 0.25), Pose((0.45, 0.28, 0.25)))
PERIOD = 1e-3


def make_filter(body, **changes):
    safety = SafetyFilter(body, random_scenes.exact_config(**changes))
    safety.observe([TABLE, SHELF, POST])
    return safety


def controller(safety, q, v, tick):
    """A controller that ignores obstacles: sideways to the post and back, down to the shelf and up; ramps of 0.1 s."""
    leg = tick // 700 % 4
    direction = ((0.0, 0.3, 0.0), (0.0, -0.3, 0.0), (0.0, 0.0, -0.35), (0.0, 0.0, 0.35))[leg]
    ramp = min(1.0, (tick % 700) / 100, (700 - tick % 700) / 100)
    twist = np.array([*direction, 0.0, 0.0, 0.0]) * ramp
    return np.linalg.pinv(safety.tool(q).jacobian) @ twist


def recorded(body, ticks, observer=None):
    """Log of a run of the controller alone: rows of (now, q, v, u_nom) as they were passed to the observer."""
    kinematics, q, v, log = SafetyFilter(body), np.array(body.home), np.zeros(7), []
    for tick in range(ticks):
        u = controller(kinematics, q, v, tick)
        log.append((tick * PERIOD, q.copy(), v.copy(), u.copy()))
        if observer:
            observer(q, v, u, tick * PERIOD)
        q, v = q + PERIOD * u, u
    return log


def filter_directly(body, log, **changes):
    """Results of a filter whose last control is the recorded command."""
    safety, u_prev, results = make_filter(body, **changes), np.zeros(7), []
    for now, q, v, u in log:
        safety.reset(u_prev)
        results.append(safety(q, v, u, now))
        u_prev = u
    return results


def runs(changed, times, join):
    """(start, end) of runs of changed ticks; gaps of at most `join` [s] belong to a run."""
    found = []
    for t in times[changed]:
        if found and t - found[-1][1] <= join:
            found[-1][1] = t
        else:
            found.append([t, t])
    return [tuple(run) for run in found]


def test_the_shadow_changes_nothing(sparse_panda):
    intervals = []
    shadow = ShadowFilter(make_filter(sparse_panda), on_interval=intervals.append)

    def observer(q, v, u, now):
        for array in (q, v, u):
            array.flags.writeable = False
        shadow.evaluate(q, v, u, now)

    with_it, alone = recorded(sparse_panda, 2800, observer), recorded(sparse_panda, 2800)
    assert all(
        np.array_equal(one, other)
        for row, twin in zip(with_it, alone, strict=True)
        for one, other in zip(row, twin, strict=True)
    )
    assert shadow.close().changed_ticks > 100
    assert intervals


def test_intervals_agree_with_a_filter_that_is_called_directly(sparse_panda):
    log, intervals = recorded(sparse_panda, 2800), []
    shadow = ShadowFilter(make_filter(sparse_panda), on_interval=intervals.append, merge_gap=0.05)
    observed = [shadow.evaluate(q, v, u, now) for now, q, v, u in log]
    total, results = shadow.close(), filter_directly(sparse_panda, log)
    assert all(np.array_equal(one.u, other.u) for one, other in zip(observed, results, strict=True))
    delta, h = np.array([a.delta for a in results]), np.array([a.h_min for a in results])
    status, times = np.array([a.status for a in results]), np.array([row[0] for row in log])
    changed = (delta > DEAD_BAND) | (status > FilterStatus.MODIFIED)
    assert [(e.start, e.end) for e in intervals] == runs(changed, times, 0.05)
    assert len(intervals) >= 2
    for interval in intervals:
        inside = (times >= interval.start) & (times <= interval.end)
        assert interval.ticks == np.sum(changed & inside)
        assert interval.peak == delta[inside & changed].max()
        assert delta[times == interval.peak_at] == interval.peak
        assert interval.h_min == h[inside & changed].min()
        assert interval.worst == FilterStatus(status[inside].max()).name
    assert (total.ticks, total.changed_ticks, total.late_calls) == (2800, changed.sum(), 0)
    assert total.changed_fraction == pytest.approx(changed.mean())
    assert total.Delta == pytest.approx(delta.mean())
    assert (total.min_h_tick.h_min, total.max_delta_tick.delta) == (h.min(), delta.max())
    assert total.min_h_tick.h_min < -0.005, "the controller alone hits obstacles"
    assert total.by_status == {s.name: np.sum(status == s) for s in FilterStatus}
    causes = {e.cause.split(" vs ")[1] for e in intervals}
    assert causes == {"'post'", "'shelf'"}
    assert "'" in total.min_h_tick.nearest
    for words in ("2800 ticks", "intervals", "mm", "% of full speed"):
        assert words in total.explain()


def test_the_last_control_is_the_command_and_not_the_result_of_the_filter(sparse_panda):
    """A filter that assumes its own results drifts from a controller that ignores them; a shadow filter does not."""
    log = recorded(sparse_panda, 700)
    shadow, drifting = ShadowFilter(make_filter(sparse_panda)), make_filter(sparse_panda)
    for now, q, v, u in log:
        seen, drifted = shadow.evaluate(q, v, u, now), drifting(q, v, u, now)
    step = max(j.acceleration.value for j in sparse_panda.joints) * PERIOD
    assert np.all(np.abs(seen.u - log[-2][3]) <= step * 1.01), "one period's acceleration away from the command"
    assert not np.allclose(drifted.u, seen.u, atol=1e-3)
    # another command of the drive can be passed
    limited = 0.5 * log[100][3]
    twin = make_filter(sparse_panda)
    twin.reset(limited)
    now, q, v, u = log[101]
    assert np.array_equal(
        ShadowFilter(make_filter(sparse_panda)).evaluate(q, v, u, now, u_prev=limited).u, twin(q, v, u, now).u
    )


def test_a_controller_within_all_limits_causes_no_interval(sparse_panda):
    safety = SafetyFilter(sparse_panda)
    safety.observe([TABLE])
    shadow, q, v = ShadowFilter(safety), np.array(sparse_panda.home), np.zeros(7)
    for tick in range(1500):
        u = 0.2 * np.sin(2.0 * np.pi * 0.8 * tick * PERIOD) * np.ones(7)
        assert shadow.evaluate(q, v, u, tick * PERIOD).delta <= DEAD_BAND
        v = v + (u - v) * PERIOD / sparse_panda.tracking.lag
        q = q + PERIOD * v
    total = shadow.close()
    assert (total.changed_fraction, total.intervals, total.max_delta_tick) == (0.0, 0, None)


def test_after_a_pause_or_a_new_clock_the_measured_velocity_counts(sparse_panda):
    home, fast = np.array(sparse_panda.home), np.full(7, 0.2)
    for later in (0.001 + 0.2, 0.0005):
        shadow = ShadowFilter(SafetyFilter(sparse_panda, random_scenes.exact_config()))
        shadow.evaluate(home, np.zeros(7), np.zeros(7), 0.001)
        assert shadow.evaluate(home, fast, fast, later).status is FilterStatus.SAFE
    shadow = ShadowFilter(SafetyFilter(sparse_panda, random_scenes.exact_config()))
    shadow.evaluate(home, np.zeros(7), np.zeros(7), 0.0)
    assert shadow.evaluate(home, fast, fast, 0.001).status is FilterStatus.MODIFIED
    shadow.evaluate(home, fast, fast, 0.004)
    assert shadow.close().late_calls == 1


@settings(max_examples=40, deadline=None)
@given(st.lists(st.sampled_from(["good", "nan q", "nan u", "nan v", "nan now", "far", "back", "huge"]), max_size=25))
def test_no_input_breaks_the_shadow(sparse_panda, kinds):
    intervals, home, now = [], np.array(sparse_panda.home), 0.0
    shadow = ShadowFilter(make_filter(sparse_panda), on_interval=intervals.append)
    for kind in kinds:
        now = 0.0 if kind == "back" else now + PERIOD
        q = np.full(7, np.nan) if kind == "nan q" else home + (9.0 if kind == "far" else 0.0)
        v = np.full(7, np.nan if kind == "nan v" else 0.0)
        u = np.full(7, {"nan u": np.nan, "huge": 1e30}.get(kind, 0.0))
        result = shadow.evaluate(q, v, u, np.nan if kind == "nan now" else now)
        assert np.all(np.isfinite(result.u))
        assert (result.status is FilterStatus.STOPPED) == (kind not in ("good", "back", "huge"))
    total = shadow.close()
    assert total.refused_ticks == sum(kind not in ("good", "back", "huge") for kind in kinds)
    assert total.min_h_tick is None or total.min_h_tick.h_min > 0.0, "a rejected tick has no h"
    assert total.intervals == len(intervals)
    for interval in intervals:
        assert json.loads(json.dumps(interval.h_min)) == interval.h_min
        assert interval.cause
    assert total.ticks == len(kinds)
    assert total.explain()


def test_causes_name_the_active_limit(sparse_panda):
    home, zero = np.array(sparse_panda.home), np.zeros(7)
    step = np.array([j.acceleration.value for j in sparse_panda.joints]) * PERIOD
    v_max = np.array([j.velocity.value for j in sparse_panda.joints])
    only = np.eye(7)[1]
    cases = {
        "panda_joint2 acceleration limit": (home, zero, 0.2 * only),
        "panda_joint2 velocity limit": (home, only * (v_max - 0.5 * step), only * (v_max + 0.5 * step)),
        "panda_joint2 position limit": (np.where(only > 0, 1.7628 - 0.03, home), 0.11 * only, 0.112 * only),
        "bad input": (home, zero, zero * np.nan),
    }
    for cause, (q, u_prev, u) in cases.items():
        safety = SafetyFilter(sparse_panda, random_scenes.exact_config())
        safety.reset(u_prev)
        result = safety(q, u_prev, u)
        assert result.cause == cause
    quiet = SafetyFilter(sparse_panda, random_scenes.exact_config())(home, zero, zero)
    assert quiet.cause == ""


def test_memory_is_bounded_and_a_long_interval_is_reported_in_pieces(sparse_panda):
    intervals, home, ball = [], np.array(sparse_panda.home), Obstacle("ball", Sphere(0.05), Pose((0.5, 0.1, 0.5)))
    safety = make_filter(sparse_panda)
    tool = safety.tool(home).position
    safety.observe([TABLE, Obstacle("ball", ball.shape, Pose(tuple(tool + np.array([0.06, 0.0, 0.06]))))])
    shadow = ShadowFilter(safety, on_interval=intervals.append, max_duration=0.1, history=50)
    for tick in range(450):
        shadow.evaluate(home, np.zeros(7), np.zeros(7), tick * PERIOD)
    total = shadow.close()
    assert len(shadow.recent) == 50
    assert [e.goes_on for e in intervals] == [True, True, True, True, False]
    assert sum(e.ticks for e in intervals) == total.changed_ticks == 450
    assert total.intervention_time == pytest.approx(0.45)
    assert {e.cause.split(" vs ")[1] for e in intervals} == {"'ball'"}


INTERVAL = InterventionInterval(
    start=1.0,
    end=1.5,
    ticks=500,
    peak=0.25,
    peak_at=1.2,
    cause="hand vs 'post'",
    worst="MODIFIED",
    h_min=-0.001,
    words="hand vs 'post' 2 mm: slowed 9 %",
)


def test_the_log_has_one_line_per_interval(tmp_path):
    path, file = tmp_path / "episodes.jsonl", InterventionLog(tmp_path / "episodes.jsonl")
    for _ in range(3):
        file(INTERVAL)
    assert read_intervention_log(path) == (INTERVAL,) * 3, "readable before it is closed"
    file.close()
    assert [json.loads(line)["cause"] for line in path.read_text("utf-8").splitlines()] == ["hand vs 'post'"] * 3


class FillingDisk:
    """A file whose disk takes 40 bytes of a line, and is free again afterwards."""

    def __init__(self, file):
        self.file, self.is_full = file, True

    def write(self, line):
        taken, self.is_full = (line[:40] if self.is_full else line), False
        return self.file.write(taken)

    def __getattr__(self, name):
        return getattr(self.file, name)


def test_a_line_that_the_disk_takes_in_part_is_an_error_and_leaves_the_others_readable(tmp_path):
    path = tmp_path / "episodes.jsonl"
    with InterventionLog(path) as log:
        log(INTERVAL)
        log._file = FillingDisk(log._file)
        with pytest.raises(OSError, match="part of the line"):
            log(INTERVAL)
        log(INTERVAL)
    assert read_intervention_log(path) == (INTERVAL,) * 2


def test_an_incomplete_line_is_not_read_and_is_removed(tmp_path):
    path = tmp_path / "episodes.jsonl"
    with InterventionLog(path) as file:
        file(INTERVAL)
    whole = path.read_bytes()
    path.write_bytes(whole + whole[:40])
    assert read_intervention_log(path) == (INTERVAL,)
    again = InterventionLog(path)
    again(INTERVAL)
    again.close()
    assert read_intervention_log(path) == (INTERVAL, INTERVAL)


def test_intervals_written_before_a_kill_are_in_the_log(tmp_path):
    path = tmp_path / "episodes.jsonl"
    code = (
        "import os, signal; from pathlib import Path;"
        "from dualbrain.safety.integration.intervention_log import InterventionInterval, InterventionLog;"
        f"log = InterventionLog(Path({str(path)!r}));"
        "common = dict(ticks=3, peak=0.1, cause='x', worst='MODIFIED', h_min=None, words='w');"
        "[log(InterventionInterval(start=float(i), end=i + 0.5, peak_at=float(i), **common)) for i in range(20)];"
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -9
    assert [interval.start for interval in read_intervention_log(path)] == list(range(20))


def test_changes_farther_apart_than_the_merge_gap_are_two_intervals(sparse_panda):
    home, zero, jump = np.array(sparse_panda.home), np.zeros(7), np.full(7, 0.1)
    for join, starts in ((0.004, [0.0, 0.006]), (0.01, [0.0])):
        intervals = []
        shadow = ShadowFilter(
            SafetyFilter(sparse_panda, random_scenes.exact_config()), on_interval=intervals.append, merge_gap=join
        )
        for tick in range(12):
            shadow.evaluate(home, zero, jump if tick in (0, 1, 6) else zero, tick * PERIOD, u_prev=zero)
        shadow.close()
        assert [e.start for e in intervals] == starts
        assert sum(e.ticks for e in intervals) == 3


def test_a_command_beyond_the_velocity_limit_counts_as_the_limit(sparse_panda):
    """Such a command was never in force; the next admissible control starts from the limit."""
    shadow, limit = ShadowFilter(SafetyFilter(sparse_panda, random_scenes.exact_config())), np.zeros(7)
    limit[6] = sparse_panda.joints[6].velocity.value
    home = np.array(sparse_panda.home)
    shadow.evaluate(home, limit, 3.0 * limit, 0.0)
    result = shadow.evaluate(home, limit, limit, PERIOD)
    assert result.status is FilterStatus.SAFE


def test_jerk_limits_are_rejected(sparse_panda):
    with pytest.raises(ConfigurationError, match="jerk"):
        ShadowFilter(make_filter(sparse_panda, jerk_limits=True))


def test_a_full_disk_does_not_reach_the_controller(sparse_panda):
    def full(_):
        raise OSError(28, "No space left on device")

    shadow = ShadowFilter(make_filter(sparse_panda), on_interval=full)
    for now, q, v, u in recorded(sparse_panda, 700):
        shadow.evaluate(q, v, u, now)
    total = shadow.close()
    assert total.write_errors == total.intervals > 0
    assert "could not be written" in total.explain()
