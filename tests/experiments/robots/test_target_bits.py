"""Recorded steps on a board: equal bits count as equal, and one other bit is found."""

import msgspec
import numpy as np
import pytest

from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.config import operating_config
from dualbrain.safety.target.target_filter import EmulatedTarget
from experiments.robots.targets.recorded_steps import compare_steps, record_steps
from experiments.robots.targets.target_bits import BUILDS, TargetBits


@pytest.fixture(scope="module")
def recorded():
    return record_steps("base", [0, 1], 600)


@pytest.fixture(scope="module")
def target():
    model = load_robot("base")
    with EmulatedTarget("an500", model, operating_config(model)) as target:
        yield target


def test_equal_steps_are_equal_and_another_bit_is_counted(recorded, target):
    kernel = target.filter().target
    assert compare_steps(recorded, target.session, kernel) == 600
    assert (kernel.steps, kernel.differences) == (600, 0)
    result = recorded.results[123]
    other = np.nextafter(result.u.astype(np.float32), np.float32(9.0)).astype(float)
    recorded.results[123] = msgspec.structs.replace(result, u=other)
    kernel = target.filter().target
    compare_steps(recorded, target.session, kernel)
    recorded.results[123] = result
    assert (kernel.steps, kernel.differences) == (600, 1)


def test_a_seed_gives_the_same_messages(recorded):
    assert record_steps("base", [0, 1], 600).messages == recorded.messages
    assert record_steps("base", [0, 2], 600).messages != recorded.messages
    assert {"SAFE", "MODIFIED", "STOPPED"} <= set(recorded.statuses)


def test_the_table_counts_steps_of_all_builds():
    counts = {"steps": 10, "controls": 9, "differences": 0, "lost": 0}
    builds = {" ".join(build): dict(counts) for build in BUILDS}
    row = {"robot": "panda", "block": 0, "builds": builds, "statuses": {"SAFE": 10}, "kernel": "k"}
    text = "\n".join(TargetBits().report([row]))
    assert "Of these 120 steps on boards, 0 have other bits than the host's: at most 2.5e-02 (95 %, one-sided" in text
    builds[" ".join(BUILDS[3])]["differences"] = 2
    text = "\n".join(TargetBits().report([row]))
    assert "2 have other bits than the host's: see the table" in text
    assert TargetBits().summarize_row(row) == "2 of 120 steps on boards differ, 0 builds lost"
