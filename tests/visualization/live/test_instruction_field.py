"""Field for instructions in the live page: who may submit, which texts are accepted, and the shown lines."""

from contextlib import nullcontext
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
        self.gui, self.html, self.field, self.submit = self, SimpleNamespace(content=""), None, None

    def on_client_connect(self, callback) -> None:
        callback(self)

    def add_html(self, *_args, **_options):
        return self.html

    def add_form(self, *_args, **_options):
        return nullcontext(SimpleNamespace(on_submit=lambda callback: setattr(self, "submit", callback)))

    def add_text(self, *_args, **_options):
        self.field = SimpleNamespace(value="")
        return self.field

    def type(self, text: str) -> None:
        """Type `text` and press Enter."""
        self.field.value = text
        self.submit(None)


def field_of(page: Page, access: OperatorAccess | None = None, answer: str = "") -> tuple[InstructionField, list[str]]:
    """The field of `page`, and the list of the instructions that its callback receives."""
    received: list[str] = []

    def submit(text: str) -> str:
        received.append(text)
        return answer

    return InstructionField(page, submit, access), received


def test_a_submitted_instruction_reaches_the_callback_once_and_the_field_is_empty_again():
    page = Page()
    _, received = field_of(page)
    page.type(f"  {WORDS} ")
    page.type("   ")
    assert received == [WORDS]
    assert page.field.value == ""
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


@pytest.mark.parametrize("length", [MAX_INSTRUCTION_LENGTH, MAX_INSTRUCTION_LENGTH + 1, 10**6])
def test_an_instruction_above_the_limit_is_not_submitted(length):
    page = Page()
    _, received = field_of(page)
    page.type("x" * length)
    assert len(received) == (length <= MAX_INSTRUCTION_LENGTH)


def test_a_refused_instruction_shows_the_reason():
    page = Page()
    field_of(page, answer="the arm is moving; type stop first")
    page.type(WORDS)
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


TYPE = f"""
const field = document.querySelector('form input');
if (!field) return null;
Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, 'value').set.call(field, '{WORDS}');
field.dispatchEvent(new Event('input', {{bubbles: true}}));
return true;"""
SUBMIT = "document.querySelector('form').requestSubmit(); return true;"
READ = "const lines = document.getElementById('instruction-lines'); return lines && lines.textContent;"


def test_an_instruction_typed_in_a_browser_reaches_the_callback(tmp_path: Path) -> None:
    robot_model = load_robot("panda")
    received: list[str] = []

    def submit(text: str) -> str:
        received.append(text)
        return ""

    few_spheres = msgspec.structs.replace(robot_model, spheres=robot_model.spheres[::12])
    view = LiveView(few_spheres, 18160, submit=submit)
    assert view.instruction_field is not None
    view.instruction_field.show_line("grasp: done", "good")
    try:
        with Browser(tmp_path / "profile", (700, 500)) as browser:
            browser.open(view.url)
            browser.wait_for(TYPE, 90.0)
            browser.execute_script(SUBMIT)
            shown = browser.wait_for(f"const t = (() => {{ {READ} }})(); return t && t.includes('red') ? t : null;")
    finally:
        view.close()
    assert received == [WORDS]
    assert shown == f"“{WORDS}”grasp: done"
