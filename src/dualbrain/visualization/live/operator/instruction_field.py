"""Field for the next instruction in the live page, with lines of progress and result below it.

The field passes the text to a callback and does nothing else with it: gate, filter and recording are on the path of
the callback. A page needs the operator's code for an instruction, as for every button that can start a motion; a stop
command needs no code.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from threading import Lock
from typing import TYPE_CHECKING, Literal

from dualbrain.core.text import storable_text
from dualbrain.grounding.instruction.stop_commands import is_stop_command
from dualbrain.visualization.html.page import element, join
from dualbrain.visualization.live.operator_buttons import OperatorAccess
from dualbrain.visualization.live.panel import panel_block

if TYPE_CHECKING:
    from viser import ClientHandle, GuiEvent, GuiFormHandle, GuiTextHandle, ViserServer

SubmitCallback = Callable[[str], str]
"""Receives an instruction; returns "" if it was accepted, else the reason. It must return without waiting."""
LineTone = Literal["plain", "good", "bad"]

MAX_INSTRUCTION_LENGTH, MAX_LINE_LENGTH, MAX_LINES = 400, 300, 12
"""Longest instruction and longest shown line [characters], number of lines."""
FIELD_ORDER, LINES_ORDER = -7.0, -6.9
"""Place in the panel: below the operator buttons, above the numbers."""
TOO_LONG = f"not accepted: an instruction has at most {MAX_INSTRUCTION_LENGTH} characters"
LOCKED = "not accepted: enter the operator's code first (a stop command needs none)"


class InstructionField:
    """A text field in every page, and lines that all pages share; every method may be called from any thread."""

    def __init__(self, server: ViserServer, submit: SubmitCallback, access: OperatorAccess | None = None) -> None:
        """Add the field to each page that opens on `server` from now on.

        Without `access` every page may submit instructions; that is for simulations.
        """
        self._submit, self._access, self._lock = submit, access, Lock()
        self._lines: deque[tuple[str, LineTone]] = deque(maxlen=MAX_LINES)
        self._html = server.gui.add_html("", order=LINES_ORDER)
        server.on_client_connect(self._add_field)

    def show_line(self, text: str, tone: LineTone = "plain") -> None:
        """Show a line of progress or of a result below the field, the newest first; the oldest lines disappear."""
        with self._lock:
            self._lines.appendleft((storable_text(text, MAX_LINE_LENGTH), tone))
            items = join(element("li", line, class_=f"line {one}") for line, one in self._lines)
            self._html.content = panel_block(element("ul", items, id="instruction-lines"))

    def enter(self, page: int, text: str) -> None:
        """Submit `text` as the instruction of `page`, and show whether it was accepted; an empty text has no effect."""
        if not (instruction := storable_text(text.strip(), MAX_INSTRUCTION_LENGTH + 1)):
            return
        if reason := self._refusal(page, instruction) or self._submit(instruction):
            self.show_line(reason, "bad")
        else:
            self.show_line(f"“{instruction}”")

    def _refusal(self, page: int, instruction: str) -> str:
        if len(instruction) > MAX_INSTRUCTION_LENGTH:
            return TOO_LONG
        unlocked = self._access is None or self._access.is_unlocked(page)
        return "" if unlocked or is_stop_command(instruction) else LOCKED

    def _add_field(self, client: ClientHandle) -> None:
        with client.gui.add_form(None, order=FIELD_ORDER) as form:
            field: GuiTextHandle = client.gui.add_text("instruction", "", hint="Enter sends it; 'stop' needs no code")

        def submitted(_: GuiEvent[GuiFormHandle]) -> None:
            text, field.value = field.value, ""
            self.enter(client.client_id, text)

        form.on_submit(submitted)
