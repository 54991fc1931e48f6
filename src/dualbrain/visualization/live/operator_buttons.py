"""Operator buttons of the live page: pause, resume, abort, takeover, speed, emergency stop and its two-step reset.

Any process that can reach the loopback address of this machine can open the page, so the page follows the rule of the
gatekeeper's socket: the emergency stop needs no code, every other button needs the operator's code, once for each page.
Foreign web pages do not get this far (`connection_guard.py`). The terminal of the run prints the code; the number of
attempts to enter it is limited (`attempt_limit.py`), the emergency stop is not. A pressed button is sent to the
gatekeeper as an operator action, which logs it as an event with its result.
"""

from __future__ import annotations

import hashlib
import hmac
import time
from collections.abc import Callable
from math import ceil, inf
from threading import Lock
from typing import TYPE_CHECKING, Any, Literal

from dualbrain.control.gatekeeper.operator_commands import UNRESTRICTED_ACTIONS
from dualbrain.control.gatekeeper.protocol.messages import OperatorAction
from dualbrain.visualization.html.page import element
from dualbrain.visualization.live.attempt_limit import AttemptLimit
from dualbrain.visualization.live.panel import panel_block

if TYPE_CHECKING:
    from viser import ClientHandle, GuiApi, ViserServer

OperateCallback = Callable[[OperatorAction, float], str]
"""Sends an action with its speed to the gatekeeper; returns "" or the reason of the failure."""

OPERATOR_BUTTONS: tuple[tuple[OperatorAction, str], ...] = (
    ("pause", "pause"),
    ("resume", "resume"),
    ("abort", "abort the contract"),
    ("takeover", "take over"),
    ("hand_back", "hand back"),
    ("release_estop", "1. release the emergency stop"),
    ("reset", "2. reset, into hold"),
)
"""Buttons that need the operator's code. A reset has no effect before the stop is released; `resume` ends the hold."""
HOTKEYS: tuple[tuple[OperatorAction, Literal["P", "R", "A"]], ...] = (("pause", "P"), ("resume", "R"), ("abort", "A"))
"""Keys of urgent actions, outside text fields; Escape is the emergency stop (`status_bar.js`)."""
MIN_SPEED_PERCENT, SPEED_STEP_PERCENT = 5, 5
"""Minimum and step of the speed slider [%]."""


class OperatorAccess:
    """Access control of the operator actions, by page."""

    def __init__(self, operate: OperateCallback, code: str, *, clock: Callable[[], float] = time.monotonic) -> None:
        """Start with all pages locked; an empty `code` unlocks none. `clock` [s] limits the rate of attempts."""
        self._operate, self._digest, self.code_length = operate, _digest(code) if code else b"", len(code)
        self._operators: set[int] = set()
        self._attempts, self._lock = AttemptLimit(clock), Lock()

    def unlock(self, page: int, code: str) -> bool:
        """Unlock `page` if `code` is the operator's code and no limit forbids the attempt; whether it is unlocked."""
        with self._lock:
            if page in self._operators or not self._digest or self._attempts.wait_s(page) > 0.0:
                return page in self._operators
            if hmac.compare_digest(_digest(code.strip()), self._digest):
                self._attempts.record_success(page)
                self._operators.add(page)
                return True
            self._attempts.record_failure(page)
            return False

    def is_unlocked(self, page: int) -> bool:
        """Whether the operator's code was entered on `page`."""
        with self._lock:
            return page in self._operators

    def describe_refusal(self, page: int) -> str:
        """Why the last code did not unlock `page`, as text for the page."""
        with self._lock:
            wait = self._attempts.wait_s(page)
        if wait == inf:
            return "too many wrong codes: load the page again, or use `dualbrain operate` in a terminal"
        return f"wrong code: the next one is read in {ceil(wait)} s" if wait > 0.0 else "wrong code"

    def remove_page(self, page: int) -> None:
        """Forget a page that was closed."""
        with self._lock:
            self._operators.discard(page)
            self._attempts.remove_page(page)

    def emergency_stop(self) -> str:
        """Send the emergency stop, which needs no code; "" or the reason of the failure."""
        return self._operate("estop", 1.0)

    def apply(self, page: int, action: OperatorAction, speed: float = 1.0) -> str:
        """Send `action` to the gatekeeper if `page` is permitted to; the result as text for the page."""
        if action not in UNRESTRICTED_ACTIONS and page not in self._operators:
            return f"{action.replace('_', ' ')}: needs the operator's code"
        why = self._operate(action, speed)
        return f"{action.replace('_', ' ')}: {why or 'sent'}"


class OperatorButtons:
    """Operator buttons of every page of the live view."""

    def __init__(self, server: ViserServer, access: OperatorAccess) -> None:
        """Add the buttons to each page that opens on `server` from now on."""
        self._access = access
        server.on_client_connect(self._add_buttons)
        server.on_client_disconnect(lambda client: access.remove_page(client.client_id))

    def _add_buttons(self, client: ClientHandle) -> None:
        page, gui = client.client_id, client.gui
        result = gui.add_html("", order=-8.0)

        def show(text: str) -> None:
            result.content = panel_block(element("p", text, id="operator-result"))

        stop = gui.add_button("EMERGENCY STOP", color="red", hint="needs no code", order=-10.0)
        stop.on_click(lambda _: show(self._access.apply(page, "estop")))
        for action, key in HOTKEYS:
            command = gui.add_command(action.capitalize(), hotkey=key, description="needs the operator's code")
            command.on_trigger(lambda _, action=action: show(self._access.apply(page, action)))
        with gui.add_folder("operator", order=-9.0, expand_by_default=False):
            code = gui.add_text("code", "", hint="printed in the terminal of the run")
            locked = self._add_locked_buttons(gui, page, show)

        def entered(_: object) -> None:
            if len(code.value.strip()) < self._access.code_length:  # the field reports every typed character
                return
            if not self._access.unlock(page, code.value):
                show(self._access.describe_refusal(page))
            elif code.visible:
                code.value, code.visible = "", False
                for one in locked:
                    one.disabled = False
                show("the buttons are unlocked")

        code.on_update(entered)

    def _add_locked_buttons(self, gui: GuiApi, page: int, show: Callable[[str], None]) -> list[Any]:
        """Add the buttons that need the code, disabled; `show` receives the result of each press."""
        found: list[Any] = []
        for action, label in OPERATOR_BUTTONS:
            button = gui.add_button(label, disabled=True)
            button.on_click(lambda _, action=action: show(self._access.apply(page, action)))
            found.append(button)
        stage = gui.add_slider("speed [%]", MIN_SPEED_PERCENT, 100, SPEED_STEP_PERCENT, 100, disabled=True)
        choose = gui.add_button("set this speed", disabled=True)
        choose.on_click(lambda _: show(self._access.apply(page, "speed", stage.value / 100.0)))
        return [*found, stage, choose]


def _digest(code: str) -> bytes:
    """Digest of a code, so that a comparison reveals neither its characters nor its length by the time it takes."""
    return hashlib.sha256(code.encode("utf-8", "surrogatepass")).digest()
