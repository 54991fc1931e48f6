"""Field for the next instruction in the bar of the live page, with lines of progress and result in its panel.

The bar sends the whole text at once (`web/own_pages.py`), because a field of viser sends typed letters after a pause of
50 ms and loses those that are typed just before Enter. The text comes with a token that viser sent to its page, so the
page is known. The field passes the text to a callback and does nothing else with it: gate, filter and recording are on
the path of the callback. A page needs the operator's code for an instruction, as for every button that can start a
motion; a stop command needs no code.
"""

from __future__ import annotations

import secrets
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
    from viser import ClientHandle, ViserServer

SubmitCallback = Callable[[str], str]
"""Receives an instruction; returns "" if it was accepted, else the reason. It must return without waiting."""
LineTone = Literal["plain", "good", "bad"]

MAX_INSTRUCTION_LENGTH, MAX_LINE_LENGTH, MAX_LINES = 400, 300, 12
"""Longest instruction and longest shown line [characters], number of lines."""
LINES_ORDER = -7.0
"""Place of the lines in the panel: below the operator buttons, above the numbers."""
UNKNOWN_PAGE = -1
"""Number of a page without a token; no code unlocks it."""
PAGE_ELEMENT, TOKEN_BYTES = "db-page", 16
"""Element of the page with its token (`web/instruction_form.js`), and the random bytes of a token."""
TOO_LONG = f"not accepted: an instruction has at most {MAX_INSTRUCTION_LENGTH} characters"
LOCKED = "not accepted: enter the operator's code first (a stop command needs none)"


class InstructionField:
    """Instructions from the field in every page, and lines that all pages share; callable from any thread."""

    def __init__(self, server: ViserServer, submit: SubmitCallback, access: OperatorAccess | None = None) -> None:
        """Accept instructions of each page that opens on `server` from now on.

        Without `access` every page may submit instructions; that is for simulations.
        """
        self._submit, self._access, self._lock = submit, access, Lock()
        self._lines: deque[tuple[str, LineTone]] = deque(maxlen=MAX_LINES)
        self._pages: dict[str, int] = {}
        self._html = server.gui.add_html("", order=LINES_ORDER)
        server.on_client_connect(self._add_page)
        server.on_client_disconnect(self._remove_page)

    def show_line(self, text: str, tone: LineTone = "plain") -> None:
        """Show a line of progress or of a result below the field, the newest first; the oldest lines disappear."""
        with self._lock:
            self._lines.appendleft((storable_text(text, MAX_LINE_LENGTH), tone))
            items = join(element("li", line, class_=f"line {one}") for line, one in self._lines)
            self._html.content = panel_block(element("ul", items, id="instruction-lines"))

    def enter(self, token: str, text: str) -> str:
        """Submit `text` as the instruction of the page with `token`, and show whether it was accepted.

        Returns "" or the reason of a refusal; an empty text has no effect.
        """
        if not (instruction := storable_text(text.strip(), MAX_INSTRUCTION_LENGTH + 1)):
            return ""
        page = self._pages.get(token, UNKNOWN_PAGE)
        reason = self._refusal(page, instruction) or self._submit(instruction)
        self.show_line(reason or f"“{instruction}”", "bad" if reason else "plain")
        return reason

    def _refusal(self, page: int, instruction: str) -> str:
        if len(instruction) > MAX_INSTRUCTION_LENGTH:
            return TOO_LONG
        unlocked = self._access is None or self._access.is_unlocked(page)
        return "" if unlocked or is_stop_command(instruction) else LOCKED

    def _add_page(self, client: ClientHandle) -> None:
        token = secrets.token_urlsafe(TOKEN_BYTES)
        self._pages[token] = client.client_id
        client.gui.add_html(panel_block(element("span", id=PAGE_ELEMENT, data_token=token)), order=LINES_ORDER)

    def _remove_page(self, client: ClientHandle) -> None:
        for token in [token for token, page in self._pages.items() if page == client.client_id]:
            self._pages.pop(token, None)
