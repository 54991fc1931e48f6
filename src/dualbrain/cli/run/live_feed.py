"""Feeds the live view from the control loop."""

from __future__ import annotations

import secrets
import sys
import time
from collections import deque
from math import inf, nan

import numpy as np
from rich.console import Console

from dualbrain.control.control_loop import TickSnapshot
from dualbrain.control.gatekeeper.protocol.messages import TickReport
from dualbrain.control.recording.trace import DEAD_BAND, Event
from dualbrain.records import Episode, Scene
from dualbrain.runtime.backends.gatekeeper import GatekeeperBackend
from dualbrain.runtime.session import Session
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import obstacles_from_scene
from dualbrain.simulation.plant.render_meshes import link_meshes
from dualbrain.visualization.live.operator_buttons import OperatorAccess
from dualbrain.visualization.live.panel import commanded_speeds
from dualbrain.visualization.live.view import LiveView
from dualbrain.visualization.live.view_state import ViewState

MAX_LINES = 12


class LiveFeed:
    """Converts snapshots of the control loop into states of the live view; averages cover the snapshots received."""

    def __init__(self, session: Session, backend: GatekeeperBackend | None, port: int, console: Console) -> None:
        """Open the view and print its address; with a gatekeeper the view has operator buttons."""
        self._robot_model = session.robot_model
        self._plant = session.plant
        self._kinematics = SafetyFilter(session.robot_model)
        code = secrets.token_urlsafe(9)
        access = OperatorAccess(backend.operate, code) if backend is not None else None
        self._view = LiveView(
            session.robot_model,
            port,
            instruction=session.config.instruction,
            access=access,
            link_meshes=link_meshes(session.plant),
        )
        self._lines: deque[str] = deque(maxlen=MAX_LINES)
        self._deltas: list[float] = []
        self._h_min = float("inf")
        self._console = console
        if self._view.notice:
            console.print(f"[yellow]{self._view.notice}[/]")
        console.print(f"live view: [bold]{self._view.url}[/]")
        if access:
            console.print(
                f"buttons: the emergency stop needs no code; all others need the operator code [bold]{code}[/]"
            )

    def on_event(self, event: Event) -> None:
        """Show an event as a line of text."""
        if event.kind != "perception":
            self._lines.append(f"{event.t:.1f} s  {event.text}")

    def on_tick(self, moment: TickSnapshot) -> None:
        """Show a tick of the control loop."""
        state, result = moment.state, moment.result
        if moment.action >= 0:
            self._deltas.append(result.delta)
            self._h_min = min(self._h_min, result.h_min)
        centres, radii, _ = self._kinematics.spheres(state.q, state.opening)
        numbers: dict[str, float | str] = {
            "h_min": result.h_min,
            "delta": result.delta,
            "Delta": float(np.mean(self._deltas)) if self._deltas else 0.0,
            "intervention_frequency": float(np.mean(np.array(self._deltas) > DEAD_BAND)) if self._deltas else 0.0,
            **commanded_speeds(self._robot_model, result.u),
            "elapsed": state.stamp,
            "phase": f"{moment.skill}: {moment.nominal.phase}",
            "status": result.status.name,
            "barriers": ", ".join(result.barriers).replace("_", " "),
            "planner": "",
        }
        frames = self._plant.link_poses()
        self._view.show(
            ViewState(
                t=state.stamp,
                frames=frames,
                scene=moment.scene,
                centres=centres,
                radii=radii,
                margins=_margins(moment.scene),
                numbers=numbers,
                lines=tuple(self._lines),
            )
        )

    def on_tick_report(self, report: TickReport) -> None:
        """Show a tick of a gatekeeper's control loop, received over the socket."""
        if report.in_contract:
            self._deltas.append(report.delta)
            self._h_min = min(self._h_min, inf if report.h_min is None else report.h_min)
        q = np.array(report.q)
        centres, radii, _ = self._kinematics.spheres(q, report.opening)
        order = f" [{report.order}: {report.check}]" if report.check else ""
        numbers: dict[str, float | str] = {
            "h_min": nan if report.h_min is None else report.h_min,
            "delta": report.delta,
            "Delta": float(np.mean(self._deltas)) if self._deltas else 0.0,
            "intervention_frequency": float(np.mean(np.array(self._deltas) > DEAD_BAND)) if self._deltas else 0.0,
            **commanded_speeds(self._robot_model, np.array(report.u)),
            "elapsed": report.t,
            "phase": f"{report.skill}: {report.phase}{order}",
            "status": report.status,
            "barriers": ", ".join(report.barriers).replace("_", " "),
            "planner": "",
        }
        self._plant.set_configuration(q, report.opening)
        frames, lines = self._plant.link_poses(), tuple(self._lines)
        margins = _margins(report.scene)
        self._view.show(
            ViewState(
                t=report.t,
                frames=frames,
                scene=report.scene,
                centres=centres,
                radii=radii,
                margins=margins,
                numbers=numbers,
                lines=lines,
            )
        )

    def finish(self, episode: Episode, *, stay: bool) -> None:
        """Show the result; with `stay` and a terminal, keep the page open until Ctrl-C."""
        self._view.finish(episode)
        if stay and sys.stdin.isatty():
            self._console.print("The live view stays open. Ctrl-C closes it.")
            try:
                while True:
                    time.sleep(0.5)
            except KeyboardInterrupt:
                pass
        self._view.close()


def _margins(scene: Scene) -> dict[str, float]:
    """Margin of the filter around each object [m]."""
    return {one.name: one.margin for one in obstacles_from_scene(scene, known=(), held=None)}
