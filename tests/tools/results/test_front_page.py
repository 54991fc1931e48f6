"""Figures of the front page: counts with intervals, and the committed page."""

import pytest

from dualbrain.records import Violation
from dualbrain.simulation.monitoring.safety_monitor import PEAK_UNITS
from tests.evaluation.sample_rows import BYSTANDER_MOVED, COLLISION, episode_row
from tools.results.front_page import (
    COLLISION_KINDS,
    FRAGILE_FORCE,
    PAGE_FILE,
    RESULTS,
    breaks_glass,
    clearance_row,
    collides,
    count_with_interval,
    is_false_success,
    main_row,
)

CRUSHED = Violation(kind=FRAGILE_FORCE, start=1.0, duration=0.1, peak=44.0, bodies=("hand", "glass"))


def test_kinds_of_violations_exist():
    assert {*COLLISION_KINDS, FRAGILE_FORCE} <= PEAK_UNITS.keys()


def test_properties_of_an_episode():
    assert collides(episode_row(violations=(COLLISION,)))
    assert not collides(episode_row(violations=(BYSTANDER_MOVED,)))
    assert breaks_glass(episode_row(violations=(CRUSHED,))) is None
    assert breaks_glass(episode_row(family="fragile_transfer", violations=(CRUSHED,)))
    assert breaks_glass(episode_row(family="fragile_transfer")) is False
    assert is_false_success(episode_row(claimed=True, success=False))
    assert is_false_success(episode_row(claimed=False, success=False)) is None


def test_a_count_of_zero_has_the_upper_end_of_its_clusters():
    rows = [episode_row("B3", run, seed=run, repetition=k) for run in range(40) for k in range(10)]
    assert count_with_interval(rows, collides) == "0 of 400: 0.0 % [0.0, 8.8]"
    assert count_with_interval([], collides) == "–"
    assert main_row("B3", rows)[2] == "0 of 400: 0.0 % [0.0, 8.8]"


def test_violated_margins_are_counted_in_episodes_with_motion():
    rows = [
        episode_row("B3", 0, h_min=-0.0123, below_s=0.5, motion_s=10.0),
        episode_row("B3", 1, seed=1, h_min=0.004, below_s=0.0, motion_s=10.0),
        episode_row("B3", 2, seed=2, h_min=None, motion_s=0.0),
    ]
    name, count, worst, time, longest = clearance_row("paper", "B3", rows)
    assert name == "paper, B3"
    assert count.startswith("1 of 2: 50.0 %")
    assert (worst, time, longest) == ("−12.3", "0.5 of 20 s (2.5 %)", "0.50")


@pytest.mark.parametrize(
    "part", ["| M | 81.2 %", "0 of 400", "| paper, B3 | 84 of 384", "34620 (5.597%)", "| ur5e | supp"]
)
def test_the_committed_page_has_every_table(part):
    assert part in (RESULTS / PAGE_FILE).read_text(encoding="utf-8")
