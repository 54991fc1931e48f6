"""Field for instructions in the live page: who may submit, which texts are accepted, and the shown lines."""

import re
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest

from dualbrain.robots.loader import load_robot
from dualbrain.visualization.live.operator.instruction_field import (
    MAX_INSTRUCTION_LENGTH,
    MAX_LINES,
    InstructionField,
)
from dualbrain.visualization.live.operator_buttons import OperatorAccess
from dualbrain.visualization.live.view import LiveView
from tests.visualization.headless_browser import Browser

CODE, WORDS = "the-code", "put the red cube in the bowl"


class Page:
    """A server with one page, without a browser."""

    client_id = 3

    def __init__(self) -> None:
        self.gui, self.field, self.leave = self, None, None
        self.html = SimpleNamespace(content="")
        self.token = ""

    def on_client_connect(self, callback) -> None:
        callback(self)

    def on_client_disconnect(self, callback) -> None:
        self.leave = lambda: callback(self)

    def add_html(self, content: str, **_options):
        if found := re.search('data-token="([^"]+)"', content):
            self.token = found[1]
        return self.html

    def type(self, text: str) -> str:
        """Type `text` and press Enter; the answer."""
        return self.field.enter(self.token, text)


def field_of(page: Page, access: OperatorAccess | None = None, answer: str = "") -> tuple[InstructionField, list[str]]:
    """The field of `page`, and the list of the instructions that its callback receives."""
    received: list[str] = []

    def submit(text: str) -> str:
        received.append(text)
        return answer

    page.field = InstructionField(page, submit, access)
    return page.field, received


def test_a_submitted_instruction_reaches_the_callback_once():
    page = Page()
    _, received = field_of(page)
    assert page.type(f"  {WORDS} ") == page.type("   ") == ""
    assert received == [WORDS]
    assert WORDS in page.html.content


def test_a_locked_page_may_only_submit_stop_commands():
    access = OperatorAccess(lambda action, speed: "", CODE)
    page = Page()
    _, received = field_of(page, access)
    page.type(WORDS)
    assert received == []
    assert "code" in page.html.content
    page.type("Stop!")
    access.unlock(page.client_id, CODE)
    page.type(WORDS)
    assert received == ["Stop!", WORDS]


def test_no_token_but_that_of_an_open_page_has_its_permissions():
    access = OperatorAccess(lambda action, speed: "", CODE)
    page = Page()
    field, received = field_of(page, access)
    access.unlock(page.client_id, CODE)
    for token in ("", "x", page.token[:-1], str(page.client_id)):
        assert "code" in field.enter(token, WORDS)
    page.leave()
    assert "code" in page.type(WORDS)
    assert received == []
    assert field.enter("", "stop") == ""
    assert received == ["stop"]


@pytest.mark.parametrize("length", [MAX_INSTRUCTION_LENGTH, MAX_INSTRUCTION_LENGTH + 1, 10**6])
def test_an_instruction_above_the_limit_is_not_submitted(length):
    page = Page()
    _, received = field_of(page)
    page.type("x" * length)
    assert len(received) == (length <= MAX_INSTRUCTION_LENGTH)


def test_a_refused_instruction_shows_the_reason():
    page = Page()
    field_of(page, answer="the arm is moving; type stop first")
    assert page.type(WORDS) == "the arm is moving; type stop first"
    assert "the arm is moving" in page.html.content
    assert WORDS not in page.html.content


def test_lines_are_escaped_limited_and_the_newest_is_first():
    page = Page()
    field, _ = field_of(page)
    for k in range(3 * MAX_LINES):
        field.show_line(f"line {k} <b>", "good")
    assert page.html.content.count("<li") == MAX_LINES
    assert "<b>" not in page.html.content
    assert page.html.content.index(f"line {3 * MAX_LINES - 1} ") < page.html.content.index(f"line {2 * MAX_LINES} ")
    field.show_line("\ud800" + "x" * 10**6, "bad")
    assert len(page.html.content) < 10_000


def open_view(port: int, received: list[str], access: OperatorAccess) -> LiveView:
    """A view of a robot with few spheres; `received` gets the instructions."""
    robot_model = load_robot("panda")
    few_spheres = msgspec.structs.replace(robot_model, spheres=robot_model.spheres[::12])
    return LiveView(few_spheres, port, access=access, submit=lambda text: received.append(text) or "")


READY = "return document.getElementById('db-page') && document.getElementById('db-instruction') && true;"
LINES = "return document.getElementById('instruction-lines')?.textContent.includes('“{}”');"
ANSWER = "return document.getElementById('db-answer').textContent;"
STATE = """
const field = document.getElementById('db-instruction');
return {value: field.value, focused: document.activeElement == field};"""
ENTER = "\ue007"
REPEATS = 20


def test_typed_text_reaches_the_callback_whole_without_a_pause_before_enter(tmp_path: Path) -> None:
    received, sent = [], []
    access = OperatorAccess(lambda action, speed: sent.append(action) or "", CODE)
    view = open_view(18160, received, access)
    try:
        with Browser(tmp_path / "profile", (700, 500)) as browser:
            browser.open(view.url)
            browser.wait_for(READY, 90.0)
            browser.type("#db-instruction", f"{WORDS}{ENTER}")
            browser.wait_for(f"{ANSWER.removesuffix(';')}.includes('code');")
            assert received == []
            (page,) = view._server.get_clients()
            access.unlock(page, CODE)
            for k in range(REPEATS):
                browser.type("#db-instruction", f"{k} {WORDS}{ENTER}")
            browser.wait_for(LINES.format(f"{REPEATS - 1} {WORDS}"))
            assert browser.execute_script(STATE) == {"value": "", "focused": True}
            assert browser.execute_script(ANSWER) == ""
    finally:
        view.close()
    assert received == [f"{k} {WORDS}" for k in range(REPEATS)]
    assert sent == [], "typed letters are not keys of the operator"
