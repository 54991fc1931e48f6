"""The number of threads of a planner: one beside a control loop, and never a processor that others use."""

import os

import pytest

from dualbrain.cli.common.planner_threads import MAX_THREADS, free_processors, planner_threads


@pytest.mark.parametrize(
    ("usable", "load", "expected"),
    [(1, 0.0, 1), (2, 0.1, 2), (2, 0.9, 1), (2, 7.0, 1), (8, 2.2, 6), (64, 0.0, MAX_THREADS)],
)
def test_busy_processors_are_left_to_others(usable, load, expected):
    assert free_processors(usable, load) == expected


def test_a_control_loop_leaves_one_thread(monkeypatch):
    monkeypatch.setattr(os, "getloadavg", lambda: (0.0, 0.0, 0.0))
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1, 2}, raising=False)
    assert planner_threads(control_loop=True) == 1
    assert planner_threads(control_loop=False) == 3
