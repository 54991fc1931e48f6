"""Operator buttons of the page: the emergency stop needs no code, every other button needs the operator's code."""

from contextlib import nullcontext
from pathlib import Path
from threading import Thread
from types import SimpleNamespace

import msgspec
import pytest

from dualbrain.control.gatekeeper.operator_commands import LATCHED_CONDITIONS, OperatorCommands, is_allowed
from dualbrain.control.gatekeeper.protocol.messages import OperatorAction, OperatorCommand
from dualbrain.robots.loader import load_robot
from dualbrain.safety.supervisor.actions import SafetyAction
from dualbrain.safety.supervisor.checks import CHECKS, RESET_HELD
from dualbrain.safety.supervisor.supervisor import Supervisor
from dualbrain.visualization.live.attempt_limit import MAX_FAILURES, MAX_PAGE_FAILURES
from dualbrain.visualization.live.operator_buttons import HOTKEYS, OPERATOR_BUTTONS, OperatorAccess, OperatorButtons
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


class Clock:
    """A clock that the test moves [s]."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def guarded(clock: Clock) -> OperatorAccess:
    return OperatorAccess(lambda action, speed: "", CODE, clock=clock)


def test_many_pages_cannot_guess_the_code_at_once() -> None:
    access = guarded(Clock())
    for page in range(1000):
        access.unlock(page, f"guess {page}")
    assert not access.unlock(5000, CODE), "not even the correct code is read during a delay"
    assert "read in" in access.describe_refusal(5000)
    assert access.apply(5000, "estop") == "estop: sent"


def test_the_delay_grows_with_each_wrong_code_and_codes_end() -> None:
    clock, times = Clock(), []
    access = guarded(clock)
    for page in range(MAX_FAILURES):
        start = clock.now
        while access._attempts.wait_s(page) > 0.0:
            assert not access.unlock(page, CODE)
            clock.now += 0.5
        access.unlock(page, "wrong")
        times.append(clock.now - start)
    assert times[:3] == [0.0, 0.0, 0.0]
    assert times[3:] == sorted(times[3:])
    assert sum(times) > 1800.0
    clock.now += 1e9
    assert not access.unlock(77, CODE)
    assert access.apply(77, "estop") == "estop: sent"
    assert "dualbrain operate" in access.describe_refusal(77)


def test_a_page_has_few_attempts_and_a_correct_code_ends_the_delays() -> None:
    clock = Clock()
    access = guarded(clock)
    for _ in range(MAX_PAGE_FAILURES):
        clock.now += 1000.0
        assert not access.unlock(1, "wrong")
    clock.now += 1000.0
    assert not access.unlock(1, CODE)
    assert "load the page again" in access.describe_refusal(1)
    assert access.unlock(2, CODE)
    assert not access.unlock(3, "wrong")
    assert access.unlock(4, CODE)


def test_parallel_attempts_are_limited_together() -> None:
    access, unlocked = guarded(Clock()), []
    guesses = [*(["wrong"] * 50), *([CODE] * 50)]
    threads = [
        Thread(target=lambda page=page, guess=guess: unlocked.append(access.unlock(page, guess)))
        for page, guess in enumerate(guesses)
    ]
    for thread in threads[:50]:
        thread.start()
    for thread in threads[:50]:
        thread.join()
    for thread in threads[50:]:
        thread.start()
    for thread in threads[50:]:
        thread.join()
    assert not any(unlocked)


@pytest.mark.parametrize("code", ["", " ", "\ud800", "\0", "the-cod\xe9", "x" * 100_000, "THE-CODE", "the-code\0"])
def test_any_text_is_a_wrong_code(code: str) -> None:
    assert not guarded(Clock()).unlock(1, code)


class Page:
    """A page without a browser: client and GUI at once; it keeps the field for the code and the shown result."""

    client_id = 7

    def __init__(self, access: OperatorAccess) -> None:
        self.gui, self.handles = self, []
        OperatorButtons(self, access)

    def on_client_connect(self, callback) -> None:
        callback(self)

    def on_client_disconnect(self, callback) -> None:
        """Never called: the page stays open."""

    def add_folder(self, *_args, **_options):
        return nullcontext()

    def __getattr__(self, name):
        if not name.startswith("add_"):
            raise AttributeError(name)
        return self._add

    def _add(self, label="", *_args, **_options):
        handle = SimpleNamespace(label=label, value="", content="", visible=True, disabled=True, press=None)
        handle.on_update = handle.on_click = handle.on_trigger = lambda callback: setattr(handle, "press", callback)
        self.handles.append(handle)
        return handle

    def type(self, text: str) -> str:
        """Type `text` character by character, as the browser reports it; returns the shown result."""
        field = next(one for one in self.handles if one.label == "code")
        for k in range(len(text)):
            field.value = text[: k + 1]
            field.press(None)
        return self.handles[0].content


def test_a_typed_code_is_one_attempt() -> None:
    access = guarded(Clock())
    page = Page(access)
    for _ in range(3):
        assert "wrong code" in page.type("xxx-code")
    assert "read in 1 s" in page.handles[0].content
    other = Page(guarded(Clock()))
    assert "unlocked" in other.type(CODE)
    assert not any(one.disabled for one in other.handles if one.label == "pause")


def test_the_keys_do_what_their_buttons_do_and_only_on_an_unlocked_page() -> None:
    access, sent = operator_access()
    page = Page(access)
    names = {action.capitalize(): action for action, _ in HOTKEYS}
    keys = {names[one.label]: one.press for one in page.handles if one.label in names}
    assert keys.keys() == dict(HOTKEYS).keys()
    for press in keys.values():
        press(None)
    assert sent == []
    access.unlock(page.client_id, CODE)
    keys["pause"](None)
    assert sent == [("pause", 1.0)]


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


@pytest.mark.parametrize(
    ("press", "release"), [("estop", "release_estop"), ("takeover", "hand_back"), ("pause", "resume")]
)
def test_a_condition_that_is_released_in_its_own_tick_holds_for_this_tick(press, release):
    """Two operators may press and release between two ticks: the stop remains one."""
    commands = OperatorCommands()
    for action in (press, release):
        assert commands.apply(OperatorCommand(act=action)) == ""
    assert commands.conditions() & LATCHED_CONDITIONS[press]
    assert commands.conditions() == 0


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
