"""Live view: a web page on the loopback address of this machine that shows a run while it happens.

The control loop passes a finished `ViewState` and continues; a thread of the view draws the newest state at its own
rate. The page can only switch what is drawn, unless it has the operator buttons (`operator_buttons.py`). It is served
to programs and pages of this machine only, never to a foreign web page (`connection_guard.py`).
"""

from __future__ import annotations

import logging
import socket
import time
from collections.abc import Callable
from dataclasses import replace
from math import inf
from threading import Event as Signal
from threading import Thread
from typing import TYPE_CHECKING

from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.records import Episode
from dualbrain.robots.model import RobotModel
from dualbrain.visualization.live.connection_guard import HOST, guard_is_active, guard_new_servers
from dualbrain.visualization.live.motion.motion_overlay import MotionOverlay, legend_html
from dualbrain.visualization.live.operator.instruction_field import InstructionField, SubmitCallback
from dualbrain.visualization.live.operator.operator_status import Situation, StatusTracker
from dualbrain.visualization.live.operator_buttons import OperatorAccess, OperatorButtons
from dualbrain.visualization.live.panel import LivePanel, final_html, numbers_html, speed_rows
from dualbrain.visualization.live.robot_view import LinkMeshes, LiveRobot
from dualbrain.visualization.live.scene_view import LiveScene
from dualbrain.visualization.live.view_state import ViewState
from dualbrain.visualization.live.web.own_pages import FAILED, IMAGE_FAILED, OwnPages

if TYPE_CHECKING:
    from viser import ViserServer

logger = logging.getLogger(__name__)

FRAME_RATE_HZ, SIGN_RATE_HZ, PANEL_RATE_HZ, DETAILS_RATE_HZ = 15.0, 7.5, 4.0, 2.0
"""Maximum rates [1/s] of robot, objects and bar; of the signs of the filter's work; of the texts; of the details
and plots.

The first is the rate at which a gatekeeper reports ticks.
"""
MAX_PORTS_TRIED = 20
RESULT_TIME_S = 0.8
"""Time [s] in which every open page asks for the result of a run at least once."""
ARM_CAMERA = (1.34, -0.92, 0.84), (0.36, 0.0, 0.12)
BASE_CAMERA = (0.4, -4.3, 3.4), (2.9, -0.3, 0.0)
"""Initial position of the camera and the point that it looks at [m], for an arm at a table and for a base in a room."""


class SlowPart:
    """A part of the page that changes less often than the robot."""

    def __init__(self, rate: float, draw: Callable[[ViewState], None]) -> None:
        """Draw it with `draw`, at most `rate` times per second [1/s]."""
        self._period, self._draw, self._next_at = 1.0 / rate, draw, -inf
        self._shown: ViewState | None = None

    def update(self, state: ViewState, now: float) -> bool:
        """Draw `state` unless it is too early at `now` [s]; whether the part shows it."""
        if state is not self._shown and now >= self._next_at:
            self._draw(state)
            self._shown, self._next_at = state, now + self._period
        return state is self._shown


class LiveView:
    """A running view at `url`; `notice` states the port if it differs from the requested one, else ""."""

    def __init__(
        self,
        robot_model: RobotModel,
        port: int = 8080,
        *,
        allow_other_port: bool = True,
        instruction: str = "",
        access: OperatorAccess | None = None,
        link_meshes: LinkMeshes | None = None,
        object_meshes: LinkMeshes | None = None,
        submit: SubmitCallback | None = None,
    ) -> None:
        """Serve on `port`, or with `allow_other_port` on the next free port.

        Links without a mesh in `link_meshes` are drawn as spheres, objects without one in `object_meshes` by their
        shape. With `access` the page has operator buttons. With
        `submit` it has a field for instructions, `instruction_field`.

        Raises:
            MissingDependencyError: viser is not installed.
            ConfigurationError: the port is in use and no other is allowed, or twenty consecutive ports are in use.
        """
        self.port = find_free_port(port, MAX_PORTS_TRIED if allow_other_port else 1)
        self.notice = "" if self.port == port else f"Port {port} is in use; the live view is on port {self.port}."
        self.url = f"http://{HOST}:{self.port}"
        self._closing, self._drawn, self._changed = Signal(), Signal(), Signal()
        self._pages = OwnPages(access.emergency_stop if access is not None else None)
        self._status, self._speeds = StatusTracker(), speed_rows(robot_model)
        self._server = start_server(self.port, self._pages)
        if robot_model.is_mobile:
            self._server.initial_camera.position, self._server.initial_camera.look_at = BASE_CAMERA
        self._robot = LiveRobot(self._server.scene, robot_model, link_meshes or {})
        self._scene = LiveScene(self._server.scene, object_meshes)
        self._overlay = MotionOverlay(self._server.scene, robot_model, link_meshes or {})
        self._panel = LivePanel(self._server.gui, self._speeds)
        self._server.gui.add_html(legend_html())
        self._add_toggles()
        if access is not None:
            OperatorButtons(self._server, access)
        self.instruction_field = InstructionField(self._server, submit, access) if submit is not None else None
        if self.instruction_field is not None:
            self._pages.enter_instruction = self.instruction_field.enter
        if instruction:
            self._panel.show_instruction(instruction)
        self._latest: ViewState | None = None
        self._episode: Episode | None = None
        self._published: tuple[ViewState | None, Episode | None] | None = None
        self._words_failed = False
        self._slow_parts = (
            SlowPart(SIGN_RATE_HZ, self._draw_signs),
            SlowPart(PANEL_RATE_HZ, self._panel.update),
            SlowPart(DETAILS_RATE_HZ, self._panel.update_details),
        )
        self._server.on_client_connect(lambda client: self._changed.set())
        self._thread = Thread(target=self._draw, name="live view", daemon=True)
        self._thread.start()

    def show(self, state: ViewState) -> None:
        """Show `state` at the next frame; returns immediately."""
        self._latest = state
        self._changed.set()

    def finish(self, episode: Episode, timeout: float = 2.0) -> None:
        """Show the result of the run; returns when it has been drawn, or after `timeout` [s]."""
        self._drawn.clear()
        self._episode = episode
        self._changed.set()
        self._drawn.wait(timeout)

    def close(self) -> None:
        """Stop serving, after open pages had time to receive the result; further calls have no effect."""
        if not self._closing.is_set():
            self._closing.set()
            self._changed.set()
            if self._episode is not None and self._server.get_clients():
                time.sleep(RESULT_TIME_S)
            self._thread.join(2.0)
            self._server.stop()
            _set_rich_quiet(quiet=False)

    def _add_toggles(self) -> None:
        gui = self._server.gui
        with gui.add_folder("show", expand_by_default=False):
            surface = gui.add_checkbox("robot", initial_value=True)
            spheres = gui.add_checkbox("spheres of the filter, by clearance", initial_value=False)
            margins = gui.add_checkbox("margins around objects", initial_value=True)

        def apply(_: object) -> None:
            self._robot.root.visible = surface.value
            self._robot.show_spheres(spheres.value)
            self._scene.show_margins(margins.value)
            self._changed.set()

        for box in (surface, spheres, margins):
            box.on_update(apply)

    def _draw(self) -> None:
        """Draw the newest state after every change, at most at `FRAME_RATE_HZ`."""
        while True:
            self._changed.wait()
            if self._closing.is_set():
                return
            start = time.monotonic()
            self._changed.clear()
            state, episode = self._latest, self._episode
            self._publish_safely(state, episode)
            self._draw_safely(state, episode)
            if episode is not None:
                self._drawn.set()
            self._closing.wait(max(0.0, start + 1.0 / FRAME_RATE_HZ - time.monotonic()))

    def _publish_safely(self, state: ViewState | None, episode: Episode | None) -> None:
        """Publish each new state at once; its words are as old as it is. A failure is stated on the page."""
        if self._published is not None and self._published[0] is state and self._published[1] is episode:
            return
        try:
            self._publish(state, episode)
        except Exception:  # the next state may be usable
            if not self._words_failed:
                logger.exception("The live view cannot describe the state of the robot.")
            self._words_failed = True
            self._pages.publish(FAILED, str, expires=False)
        else:
            self._published, self._words_failed = (state, episode), False

    def _draw_safely(self, state: ViewState | None, episode: Episode | None) -> None:
        """Draw the scene; a failure is stated on the page beside the words, and does not end the view."""
        try:
            self._draw_one(state, episode)
        except Exception:  # the next state may be usable
            if not self._pages.image_problem:
                logger.exception("The live view cannot draw the scene.")
            self._pages.image_problem = IMAGE_FAILED
        else:
            self._pages.image_problem = ""

    def _publish(self, state: ViewState | None, episode: Episode | None) -> None:
        """Publish the words and numbers of the pages that do not need the 3D client."""
        situation = state.situation if state is not None else Situation()
        if episode is not None:
            kind, reason = episode.outcome.kind.replace("_", " "), episode.outcome.reason
            situation = replace(situation, result=f"{kind}. {reason[:1].upper()}{reason[1:]}.")

        def numbers() -> str:
            if episode is not None:
                return final_html(episode)
            return numbers_html(state, self._speeds) if state is not None else ""

        status, ended = self._status.update(situation), episode is not None
        expires = situation.in_contract or (state is not None and state.is_periodic)
        self._pages.publish(status, numbers, expires=expires and not ended, ended=ended)

    def _draw_one(self, state: ViewState | None, episode: Episode | None) -> None:
        if episode is None and not self._server.get_clients():  # a page that opens sets `_changed`
            return
        with self._server.atomic():
            if state is not None:
                self._robot.update(state)
                self._scene.update(state)
                self._overlay.follow_tool(state)
                now = time.monotonic()
                if not all([part.update(state, now) for part in self._slow_parts]):
                    self._changed.set()  # the late parts are drawn with a later frame
            if episode is not None:
                self._panel.finish(episode)

    def _draw_signs(self, state: ViewState) -> None:
        self._robot.tint(state.limiting_links)
        self._overlay.update(state)


def find_free_port(first_port: int, max_tries: int) -> int:
    """The first free port from `first_port` on.

    Raises:
        ConfigurationError: none of `max_tries` consecutive ports is free.
    """
    for port in range(first_port, min(first_port + max_tries, 65536)):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, port))
            except OSError:
                continue
            return port
    raise ConfigurationError(
        "port of the live view",
        got=first_port,
        allowed=f"a free port on {HOST} (tried {max_tries})",
        fix="Choose another with --port, or run with --headless.",
    )


def start_server(port: int, pages: OwnPages | None = None) -> ViserServer:
    """A viser server on the loopback address of this machine, without the button that opens a public tunnel.

    It refuses every request of a foreign page (`connection_guard.py`), and answers requests for `pages` with them.

    Raises:
        MissingDependencyError: viser is not installed.
        ConfigurationError: another program took the port, or this version of viser does not accept the guard.
    """
    try:
        import viser  # noqa: PLC0415  (heavy imports are lazy)
    except ImportError as error:
        raise MissingDependencyError(
            "viser, which draws the live view,",
            fix="Install it with `pip install 'dualbrain[view]'`, or run with --headless.",
        ) from error
    _set_rich_quiet(quiet=True)
    with guard_new_servers(pages):
        server = viser.ViserServer(host=HOST, port=port, label="dualbrain", verbose=False)
    if server.get_port() != port or not guard_is_active(port):
        server.stop()
        _set_rich_quiet(quiet=False)
        raise ConfigurationError.stating(
            f"The live view on port {port} cannot refuse foreign web pages.",
            fix="Choose another port with --port, install viser 1.1 (`pip install 'viser==1.1.1'`), or use --headless.",
        )
    server.request_share_url = lambda verbose=True: None  # a page must not be able to open a public tunnel
    server.gui.main_panel.dock_right()
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
    server.scene.set_up_direction("+z")
    server.initial_camera.position, server.initial_camera.look_at = ARM_CAMERA
    return server


def _set_rich_quiet(*, quiet: bool) -> None:
    """Suppress the banners of viser on standard output; viser prints them through the global console of rich."""
    import rich  # noqa: PLC0415

    rich.get_console().quiet = quiet
