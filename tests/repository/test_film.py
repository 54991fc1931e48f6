"""The runs behind the film of the README: without the filter the robot touches the person, with it never."""

import pytest

pytest.importorskip("mujoco")

from scripts.filter_demo import open_demo_world, run_demo

END_S = 4.6
"""Time [s] at which the collision without the filter has happened."""


@pytest.mark.parametrize("guard", [False, True])
def test_only_the_unfiltered_run_touches_the_person(guard: bool) -> None:
    least = float("inf")
    for tick in run_demo(open_demo_world(), guard=guard):
        least = min(least, tick.distance)
        if tick.state.stamp > END_S or least < 0.0:
            break
    assert least > 0.01 if guard else least < 0.0
