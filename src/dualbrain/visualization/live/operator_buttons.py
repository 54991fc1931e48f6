"""A person's buttons on the live page: pause, resume, abort, takeover, speed, emergency stop, and its reset in steps.

The page is open to whoever can reach this machine's loopback address, so the rule is the socket's own: everyone may
press the emergency stop; everything else needs the operator's code, which is told where the run was started, once for
each page. What is pressed goes to the gatekeeper as an operator's act and is its event, with its own outcome.
"""

from __future__ import annotations

import hmac
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from dualbrain.control.gatekeeper.operator_commands import UNRESTRICTED_ACTIONS
from dualbrain.control.gatekeeper.protocol.messages import OperatorAction
from dualbrain.visualization.html.page import element
from dualbrain.visualization.live.panel import PANEL_CSS

if TYPE_CHECKING:
    from viser import ClientHandle, GuiApi, ViserServer

OperateCallback = Callable[[OperatorAction, float], str]
"""Carries an act to the gatekeeper; "" or why it could not."""

OPERATOR_BUTTONS: tuple[tuple[OperatorAction, str], ...] = (
    ("pause", "pause"),
    ("resume", "resume"),
    ("abort", "abort the contract"),
    ("takeover", "take over"),
    ("hand_back", "hand back"),
    ("release_estop", "1. release the emergency stop"),
    ("reset", "2. reset, into hold"),
)
"""Those that need the operator's code. A reset does nothing before the stop is released; `resume` leads out."""
MIN_SPEED_PERCENT, SPEED_STEP_PERCENT = 5, 5
"""Of the speed stage [%]."""


class OperatorAccess:
    """Who may press what, page by page; knows nothing of how a page looks."""

    def __init__(self, operate: OperateCallback, code: str) -> None:
        """Every page is a stranger's at first."""
        self._operate, self._code = operate, code
        self._operators: set[int] = set()

    def unlock(self, page: int, code: str) -> bool:
        """Whether `code` is the operator's; if so that page is from now on."""
        if self._code and hmac.compare_digest(code.strip().encode(), self._code.encode()):
            self._operators.add(page)
        return page in self._operators

    def remove_page(self, page: int) -> None:
        """The page was closed."""
        self._operators.discard(page)

    def apply(self, page: int, action: OperatorAction, speed: float = 1.0) -> str:
        """Do what was pressed, if that page may; what to tell the person."""
        if action not in UNRESTRICTED_ACTIONS and page not in self._operators:
            return f"{action.replace('_', ' ')}: needs the operator's code"
        why = self._operate(action, speed)
        return f"{action.replace('_', ' ')}: {why or 'sent'}"


class OperatorButtons:
    """Puts the board's buttons on every page that is opened."""

    def __init__(self, server: ViserServer, access: OperatorAccess) -> None:
        """From now on."""
        self._access = access
        server.on_client_connect(self._add_buttons)
        server.on_client_disconnect(lambda client: access.remove_page(client.client_id))

    def _add_buttons(self, client: ClientHandle) -> None:
        page, gui = client.client_id, client.gui
        said = gui.add_html("", order=-8.0)

        def tell(text: str) -> None:
            said.content = PANEL_CSS + element("div", element("p", text, id="operator-said"), class_="db")

        stop = gui.add_button("EMERGENCY STOP", color="red", hint="needs no code", order=-10.0)
        stop.on_click(lambda _: tell(self._access.apply(page, "estop")))
        with gui.add_folder("operator", order=-9.0, expand_by_default=False):
            code = gui.add_text("code", "", hint="as it was told where the run was started")
            locked = self._add_locked_buttons(gui, page, tell)

        def entered(_: object) -> None:
            if self._access.unlock(page, code.value):
                code.value, code.visible = "", False
                for one in locked:
                    one.disabled = False
                tell("these buttons are yours")

        code.on_update(entered)

    def _add_locked_buttons(self, gui: GuiApi, page: int, tell: Callable[[str], None]) -> list[Any]:
        """The buttons that wait for the code."""
        found: list[Any] = []
        for act, label in OPERATOR_BUTTONS:
            button = gui.add_button(label, disabled=True)
            button.on_click(lambda _, act=act: tell(self._access.apply(page, act)))
            found.append(button)
        stage = gui.add_slider("speed [%]", MIN_SPEED_PERCENT, 100, SPEED_STEP_PERCENT, 100, disabled=True)
        choose = gui.add_button("set this speed", disabled=True)
        choose.on_click(lambda _: tell(self._access.apply(page, "speed", stage.value / 100.0)))
        return [*found, stage, choose]
