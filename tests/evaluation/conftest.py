"""A small suite and synthetic results of its episodes."""

import pytest

from dualbrain.evaluation.protocol.suite import parse_suite
from tests.evaluation.sample_rows import COLLISION, SUITE, episode_row

FAILED_EPISODE = {"success": False, "claimed": False, "failure": "collision", "outcome": "taken_over"}


@pytest.fixture(scope="module")
def suite():
    return parse_suite(SUITE, "tiny.toml")


@pytest.fixture(scope="module")
def rows():
    """Two runs of two repetitions: without a filter every second episode collides and fails."""
    found = []
    for method in ("B1", "B3", "M"):
        for run in (0, 1):
            for k in (0, 1):
                hurt = method == "B1" and k == 1
                values = {"violations": (COLLISION,), "severity": 0.1, **FAILED_EPISODE} if hurt else {}
                found.append(episode_row(method, run, seed=run, repetition=k, guarded=method != "B1", **values))
    return found
