"""Operator buttons of the page: the emergency stop needs no code, every other button needs the operator's code."""

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
ACTIONS = [action for action in OperatorAction.__args__ if action != "shut_down"]


def operator_access():
    """Access control, and the list of the actions that it sends."""
    sent = []

    def operate(action, speed):
        sent.append((action, speed))
        return ""

    return OperatorAccess(operate, CODE), sent


@pytest.mark.parametrize("action", ACTIONS)
def test_a_locked_page_may_do_what_an_observer_of_the_socket_may(action):
    access, sent = operator_access()
    result = access.apply(1, action)
    assert bool(sent) is is_allowed(action, "observer")
    assert ("code" in result) is not is_allowed(action, "observer")


@pytest.mark.parametrize("action", ACTIONS)
def test_the_code_unlocks_one_page_only(action):
    access, sent = operator_access()
    assert not access.unlock(1, "wrong")
    assert access.unlock(1, f" {CODE} ")
    assert access.apply(1, action, 0.5) == f"{action.replace('_', ' ')}: sent"
    assert sent == [(action, 0.5)]
    access.apply(2, action)
    assert (len(sent) == 2) is (action == "estop")


def test_a_closed_page_is_locked_again_and_an_empty_code_unlocks_nothing():
    access, sent = operator_access()
    access.unlock(1, CODE)
    access.remove_page(1)
    access.apply(1, "pause")
    assert sent == []
    assert not OperatorAccess(lambda action, speed: "", "").unlock(1, "")


def test_the_reason_of_a_failed_action_is_shown():
    assert (
        OperatorAccess(lambda action, speed: "there is no gatekeeper", CODE).apply(3, "estop").endswith("no gatekeeper")
    )


def test_every_action_has_a_button_and_an_outcome():
    """Every intervening action trips a check that ends the contract with an outcome of its own, or marks it."""
    buttons = {action for action, _ in OPERATOR_BUTTONS} | {"estop", "speed"}
    assert buttons == set(ACTIONS)
    outcomes = {"abort": "aborted", "takeover": "handed_over", "estop": "emergency"}
    for action, outcome in outcomes.items():
        commands, supervisor = OperatorCommands(), Supervisor()
        assert commands.apply(OperatorCommand(act=action)) == ""
        supervisor.update(0.0, commands.conditions())
        assert supervisor.contract_outcome == outcome
    assert {check.name for check in CHECKS} >= {"paused", "speed_stage"}


def test_the_reset_takes_two_buttons_and_ends_in_hold():
    commands, supervisor, now = OperatorCommands(), Supervisor(), 0.0

    def press(*actions):
        nonlocal now
        for action in actions:
            access.apply(1, action)
        for _ in range(100):
            now += 0.01
            decision = supervisor.update(now, commands.conditions())
        return decision

    access = OperatorAccess(lambda action, speed: commands.apply(OperatorCommand(act=action, speed=speed)), CODE)
    access.unlock(1, CODE)
    assert press("estop").action is SafetyAction.ESTOP
    assert press("reset").action is SafetyAction.ESTOP, "a reset before the release has no effect"
    assert press("release_estop").action is SafetyAction.ESTOP
    assert press("reset").check == RESET_HELD.name
    assert press("resume").action is SafetyAction.NONE


CLICK = """
const find = text => [...document.querySelectorAll('button')].find(one => one.textContent.trim() == text);
const button = find(%r);
if (!button) return null;
button.click();
const result = document.getElementById('operator-result');
return result && result.textContent.includes('sent') ? {
  result: result.textContent, locked: (find('pause') || {disabled: true}).disabled,
} : null;"""


def test_a_locked_page_in_a_browser_can_only_stop_the_arm(tmp_path: Path) -> None:
    robot_model = load_robot("panda")
    access, sent = operator_access()
    view = LiveView(msgspec.structs.replace(robot_model, spheres=robot_model.spheres[::12]), 18130, access=access)
    try:
        with Browser(tmp_path / "profile", (700, 500)) as browser:
            browser.open(view.url)
            found = browser.wait_for(CLICK % "EMERGENCY STOP", 90.0)
    finally:
        view.close()
    assert found == {"result": "estop: sent", "locked": True}
    assert set(sent) == {("estop", 1.0)}
