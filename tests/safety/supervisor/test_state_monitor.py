"""The state monitor: a joint state with a number that is missing or not finite is implausible."""

from dataclasses import replace

import numpy as np
import pytest

from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.state_monitor import StateMonitor

PANDA = load_robot("panda")
HOME = home_state(PANDA)


def with_value(name, value):
    if name in ("q", "v"):
        values = getattr(HOME, name).copy()
        values[3] = value
        return replace(HOME, **{name: values})
    return replace(HOME, **{name: (1.0, value) if name == "finger_forces" else value})


@pytest.mark.parametrize("name", ["q", "v", "opening", "finger_forces"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_a_number_that_is_not_finite_is_implausible(name, value):
    assert StateMonitor(PANDA).check_state(with_value(name, value), 0.0) & Condition.STATE_IMPLAUSIBLE


@pytest.mark.parametrize("name", ["q", "v"])
@pytest.mark.parametrize("count", [0, 1, 6, 8, 100])
def test_a_state_of_another_number_of_joints_is_implausible(name, count):
    monitor = StateMonitor(PANDA)
    assert not monitor.check_state(HOME, 0.0)
    wrong = replace(HOME, sequence=1, stamp=0.001, **{name: np.zeros(count)})
    assert monitor.check_state(wrong, 0.001) & Condition.STATE_IMPLAUSIBLE


def test_a_state_at_home_is_plausible():
    assert StateMonitor(PANDA).check_state(HOME, 0.0) == 0
    assert StateMonitor(PANDA).check_state(replace(HOME, opening=None), 0.0) == 0
