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
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import obstacles_from_scene
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.plant.render_meshes import link_meshes
from dualbrain.visualization.live.operator.instruction_field import LineTone, SubmitCallback
from dualbrain.visualization.live.operator_buttons import OperateCallback, OperatorAccess
from dualbrain.visualization.live.panel import commanded_speeds
from dualbrain.visualization.live.view import LiveView
from dualbrain.visualization.live.view_state import ViewState

MAX_LINES = 12


class LiveFeed:
    """Converts snapshots of the control loop into states of the live view; averages cover the snapshots received."""

    def __init__(
        self,
        robot_model: RobotModel,
        plant: Plant,
        port: int,
        console: Console,
        *,
        instruction: str = "",
        operate: OperateCallback | None = None,
        submit: SubmitCallback | None = None,
    ) -> None:
        """Open the view of `plant` and print its address.

        With `operate`, which sends operator actions to a gatekeeper, the view has operator buttons; with `submit` it
        has a field for instructions.
        """
        self._robot_model, self._plant = robot_model, plant
        self._kinematics = SafetyFilter(robot_model)
        code = secrets.token_urlsafe(9)
        access = OperatorAccess(operate, code) if operate is not None else None
        self._view = LiveView(
            robot_model,
            port,
            instruction=instruction,
            access=access,
            link_meshes=link_meshes(plant),
            submit=submit,
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

    def follow(self, plant: Plant) -> None:
        """Show another run of the same robot from now on; averages begin again."""
        self._plant = plant
        self._lines.clear()
        self._deltas, self._h_min = [], inf

    def show_at_rest(self, scene: Scene) -> None:
        """Show the plant and a perceived `scene` before the first run."""
        self._view.show(ViewState(t=0.0, frames=self._plant.link_poses(), scene=scene, margins=_margins(scene)))

    def show_line(self, text: str, tone: LineTone = "plain") -> None:
        """Show a line below the field for instructions, if there is one."""
        if self._view.instruction_field is not None:
            self._view.instruction_field.show_line(text, tone)

    def close(self) -> None:
        """Close the page."""
        self._view.close()

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
