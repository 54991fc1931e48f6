"""The operator's numbers: a speed is permitted only to a robot that moves."""

import re

import pytest

from dualbrain.records import Scene
from dualbrain.visualization.live.operator.operator_status import Situation
from dualbrain.visualization.live.panel import plain_html
from dualbrain.visualization.live.view_state import ViewState

EMPTY = Scene(robot="panda", stamp=0.0, version=1, objects=(), places=())
CARRYING = Situation(in_contract=True, phase="carry", delta=0.1, speed_share=0.4)


def permitted_speed(situation):
    shown = plain_html(ViewState(t=0.0, frames={}, scene=EMPTY, situation=situation))
    return re.search(r"id=['\"]plain-speed['\"][^>]*>([^<]*)", str(shown))[1]


def test_a_moving_robot_is_shown_with_the_share_of_its_speed():
    assert permitted_speed(CARRYING) == "40"


@pytest.mark.parametrize(
    "situation",
    [
        Situation(in_contract=True, action="HOVER", check="paused"),
        Situation(in_contract=True, action="ESTOP", check="estop"),
        Situation(in_contract=True, filter_status="STOPPED"),
        Situation(),
    ],
    ids=["paused", "emergency stop", "filter brakes", "no contract"],
)
def test_a_robot_that_does_not_move_is_shown_without_a_speed(situation):
    assert permitted_speed(situation) == "–"
