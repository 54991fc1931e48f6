"""Tick timing: a short run of a gatekeeper under load, and its report."""

import json

import pytest

from dualbrain.control.gatekeeper.timing.tick_profile import TICK_PARTS
from dualbrain.core.paths import cache_folder
from dualbrain.core.weights import locate_weights
from dualbrain.planner.registry import SMALL_PLANNER
from experiments.figures.plot_tick import plot_tick
from experiments.gatekeeper.tick import TickTiming


@pytest.mark.slow
def test_a_short_run_under_load(tmp_path):
    locate_weights(SMALL_PLANNER, cache_folder())
    parameters = {"seconds": 12.0, "planner": SMALL_PLANNER, "variant": "thread"}
    row = json.loads(json.dumps(TickTiming().run(parameters), default=float))
    assert row["ticks"] > 5000
    assert sum(row["bins"].values()) == row["ticks"] - 1
    assert row["contracts"]["given, accepted"] >= 1
    assert row["parts"]["skills"]["ticks"] > 1000, "the arm moved"
    assert row["parts"]["show"]["ticks"] > 50, "and the live view was updated"
    assert row["page"][0] > 0
    assert len(row["decisions"]) >= 1
    assert row["recording"]["complete"]
    assert row["violations"] == []
    assert row["control_thread"]["malformed"] == row["control_thread"]["unsent"] == 0
    parts = [part for name, part in row["parts"].items() if name != "wait"]
    assert 0.3 < sum(part["mean"] * part["ticks"] for part in parts) / (row["ticks"] * row["work"][0]) < 3.0
    text = "\n".join(TickTiming().report([row]))
    assert f"**{row['robot_ticks']}** periods of the robot" in text
    plot_tick(row, tmp_path / "images" / "tick.png")
    assert (tmp_path / "images" / "tick.png").stat().st_size < 100_000


@pytest.mark.parametrize("variant", ["loop", "thread"])
def test_the_report_states_the_values_of_the_row(variant):
    part = {"ticks": 500, "mean": 2e-5, "quantiles": [1e-5, 3e-5, 4e-5, 5e-5]}
    row = {
        "variant": variant,
        "control_thread": {"max_work": 0.00034} if variant == "thread" else None,
        "silent_periods": 17,
        "longest_silence": 0.0123,
        "ticks": 1000,
        "robot_ticks": 1003,
        "missed": 3,
        "late": 5,
        "slips": 0,
        "bins": {"49": 997, "999": 2},
        "interval": [1e-3] * 4,
        "work": [3e-4] * 4,
        "latency": [2e-4] * 4,
        "parts": dict.fromkeys(TICK_PARTS, part),
        "decisions": [2.0, 4.0, 3.0],
        "planner": "some-planner",
        "contracts": {"given, accepted": 4},
        "outcomes": {"succeeded": 4},
        "page": [9, 5e5],
        "recording": {"complete": True, "dropped": 0, "bytes": 3e6},
        "violations": [],
    }
    text = "\n".join(TickTiming().report([row]))
    assert "**1003** periods of the robot, **500** ticks of the loop; **503** ticks missed (50.15%), 3 states" in text
    limit = "50" if variant == "thread" else "1"
    assert f"(over {limit} ms of work): **5** (1.00%). Stalls of over 20 ms: **2**, the longest 1 ms" in text
    assert "| 1003 | 17 | 1.695% [1.695%, 1.695%] | 12.3 ms | 0.50% |" in text
    assert ("| 0.34 ms |" in text) == (variant == "thread")
    assert "3 plans of `some-planner` (median 3.0 s); contracts: given, accepted 4" in text
    assert "| filter | " in text
    assert "| wait | " not in text
