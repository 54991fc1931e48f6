"""The page's buttons keep the socket's rule: anyone may stop the arm, everything else needs the operator's code."""

from pathlib import Path

import msgspec
import pytest

from dualbrain.control.gatekeeper.operator_commands import OperatorCommands, is_allowed
from dualbrain.control.gatekeeper.protocol.messages import OperatorAction, OperatorCommand
from dualbrain.robots.loader import load_robot
from dualbrain.safety.supervisor.actions import SafetyAction
from dualbrain.safety.supervisor.checks import CHECKS, RESET_HELD
from dualbrain.safety.supervisor.supervisor import Supervisor
from dualbrain.visualization.live.operator_buttons import OPERATOR_BUTTONS, OperatorAccess
from dualbrain.visualization.live.view import LiveView
from tests.visualization.headless_browser import Browser

CODE = "the-code"
ACTS = [act for act in OperatorAction.__args__ if act != "shut_down"]


def board():
    told = []

    def operate(act, speed):
        told.append((act, speed))
        return ""

    return OperatorAccess(operate, CODE), told


@pytest.mark.parametrize("act", ACTS)
def test_a_stranger_may_press_what_any_peer_of_the_socket_may(act):
    one, told = board()
    said = one.apply(1, act)
    assert bool(told) is is_allowed(act, "observer")
    assert ("code" in said) is not is_allowed(act, "observer")


@pytest.mark.parametrize("act", ACTS)
def test_with_the_code_a_page_is_the_operators_and_no_other_page_is(act):
    one, told = board()
    assert not one.unlock(1, "wrong")
    assert one.unlock(1, f" {CODE} ")
    assert one.apply(1, act, 0.5) == f"{act.replace('_', ' ')}: sent"
    assert told == [(act, 0.5)]
    one.apply(2, act)
    assert (len(told) == 2) is (act == "estop")


def test_a_page_that_was_closed_is_a_stranger_again_and_no_code_opens_nothing():
    one, told = board()
    one.unlock(1, CODE)
    one.remove_page(1)
    one.apply(1, "pause")
    assert told == []
    assert not OperatorAccess(lambda act, speed: "", "").unlock(1, "")


def test_why_the_gatekeeper_was_not_told_is_shown():
    assert OperatorAccess(lambda act, speed: "there is no gatekeeper", CODE).apply(3, "estop").endswith("no gatekeeper")


def test_every_act_has_a_button_and_is_an_event_with_an_outcome():
    """Every button that interferes trips a check that ends the contract in a class of its own, or marks it."""
    buttons = {act for act, _ in OPERATOR_BUTTONS} | {"estop", "speed"}
    assert buttons == set(ACTS)
    ends = {"abort": "aborted", "takeover": "handed_over", "estop": "emergency"}
    for act, ending in ends.items():
        hand, supervisor = OperatorCommands(), Supervisor()
        assert hand.apply(OperatorCommand(act=act)) == ""
        supervisor.update(0.0, hand.conditions())
        assert supervisor.contract_outcome == ending
    assert {check.name for check in CHECKS} >= {"paused", "speed_stage"}


def test_the_reset_is_two_buttons_and_lands_in_hold():
    hand, supervisor, now = OperatorCommands(), Supervisor(), 0.0

    def press(*acts):
        nonlocal now
        for act in acts:
            one.apply(1, act)
        for _ in range(100):
            now += 0.01
            order = supervisor.update(now, hand.conditions())
        return order

    one = OperatorAccess(lambda act, speed: hand.apply(OperatorCommand(act=act, speed=speed)), CODE)
    one.unlock(1, CODE)
    assert press("estop").action is SafetyAction.ESTOP
    assert press("reset").action is SafetyAction.ESTOP, "a reset while the button is down does nothing"
    assert press("release_estop").action is SafetyAction.ESTOP
    assert press("reset").check == RESET_HELD.name
    assert press("resume").action is SafetyAction.NONE


CLICK = """
const find = text => [...document.querySelectorAll('button')].find(one => one.textContent.trim() == text);
const button = find(%r);
if (!button) return null;
button.click();
const said = document.getElementById('operator-said');
return said && said.textContent.includes('sent') ? {
  said: said.textContent, locked: (find('pause') || {disabled: true}).disabled,
} : null;"""


def test_a_browser_stops_the_arm_and_nothing_else_is_free(tmp_path: Path) -> None:
    robot_model = load_robot("panda")
    one, told = board()
    view = LiveView(msgspec.structs.replace(robot_model, spheres=robot_model.spheres[::12]), 18130, access=one)
    try:
        with Browser(tmp_path / "profile", (700, 500)) as browser:
            browser.open(view.url)
            found = browser.wait_for(CLICK % "EMERGENCY STOP", 90.0)
    finally:
        view.close()
    assert found == {"said": "estop: sent", "locked": True}
    assert set(told) == {("estop", 1.0)}
