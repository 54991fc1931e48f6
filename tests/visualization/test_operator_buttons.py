"""The page's buttons keep the socket's rule: anyone may stop the arm, everything else needs the operator's code."""

from pathlib import Path

import msgspec
import pytest

from dualbrain.control.gatekeeper.operator_commands import Hand, allowed
from dualbrain.control.gatekeeper.protocol.messages import Act, Operate
from dualbrain.robots.loader import load_body
from dualbrain.safety.supervisor.actions import Rung
from dualbrain.safety.supervisor.checks import CHECKS, RESET_HELD
from dualbrain.safety.supervisor.supervisor import Supervisor
from dualbrain.visualization.live.operator_buttons import BUTTONS, OperatorBoard
from dualbrain.visualization.live.view import LiveView
from tests.visualization.headless_browser import Browser

CODE = "the-code"
ACTS = [act for act in Act.__args__ if act != "shut_down"]


def board():
    told = []

    def operate(act, speed):
        told.append((act, speed))
        return ""

    return OperatorBoard(operate, CODE), told


@pytest.mark.parametrize("act", ACTS)
def test_a_stranger_may_press_what_any_peer_of_the_socket_may(act):
    one, told = board()
    said = one.press(1, act)
    assert bool(told) is allowed(act, "observer")
    assert ("code" in said) is not allowed(act, "observer")


@pytest.mark.parametrize("act", ACTS)
def test_with_the_code_a_page_is_the_operators_and_no_other_page_is(act):
    one, told = board()
    assert not one.unlock(1, "wrong")
    assert one.unlock(1, f" {CODE} ")
    assert one.press(1, act, 0.5) == f"{act.replace('_', ' ')}: sent"
    assert told == [(act, 0.5)]
    one.press(2, act)
    assert (len(told) == 2) is (act == "estop")


def test_a_page_that_was_closed_is_a_stranger_again_and_no_code_opens_nothing():
    one, told = board()
    one.unlock(1, CODE)
    one.forget(1)
    one.press(1, "pause")
    assert told == []
    assert not OperatorBoard(lambda act, speed: "", "").unlock(1, "")


def test_why_the_gatekeeper_was_not_told_is_shown():
    assert OperatorBoard(lambda act, speed: "there is no gatekeeper", CODE).press(3, "estop").endswith("no gatekeeper")


def test_every_act_has_a_button_and_is_an_event_with_an_outcome():
    """Every button that interferes trips a check that ends the contract in a class of its own, or marks it."""
    buttons = {act for act, _ in BUTTONS} | {"estop", "speed"}
    assert buttons == set(ACTS)
    ends = {"abort": "aborted", "takeover": "handed_over", "estop": "emergency"}
    for act, ending in ends.items():
        hand, supervisor = Hand(), Supervisor()
        assert hand.act(Operate(act=act)) == ""
        supervisor.update(0.0, hand.conditions())
        assert supervisor.ending == ending
    assert {check.name for check in CHECKS} >= {"paused", "speed_stage"}


def test_the_reset_is_two_buttons_and_lands_in_hold():
    hand, supervisor, now = Hand(), Supervisor(), 0.0

    def press(*acts):
        nonlocal now
        for act in acts:
            one.press(1, act)
        for _ in range(100):
            now += 0.01
            order = supervisor.update(now, hand.conditions())
        return order

    one = OperatorBoard(lambda act, speed: hand.act(Operate(act=act, speed=speed)), CODE)
    one.unlock(1, CODE)
    assert press("estop").action is Rung.ESTOP
    assert press("reset").action is Rung.ESTOP, "a reset while the button is down does nothing"
    assert press("release_estop").action is Rung.ESTOP
    assert press("reset").check == RESET_HELD.name
    assert press("resume").action is Rung.NONE


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
    body = load_body("panda")
    one, told = board()
    view = LiveView(msgspec.structs.replace(body, spheres=body.spheres[::12]), 18130, board=one)
    try:
        with Browser(tmp_path / "profile", (700, 500)) as browser:
            browser.open(view.url)
            found = browser.wait_for(CLICK % "EMERGENCY STOP", 90.0)
    finally:
        view.close()
    assert found == {"said": "estop: sent", "locked": True}
    assert set(told) == {("estop", 1.0)}
