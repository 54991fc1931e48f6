"""Feeds the live view from the control loop."""

from __future__ import annotations

import secrets
import sys
import time
from collections import deque
from dataclasses import replace
from math import inf, nan

import numpy as np
from rich.console import Console

from dualbrain.contracts.contract import Contract
from dualbrain.contracts.verdict import Accepted
from dualbrain.control.control_loop import TickSnapshot
from dualbrain.control.gatekeeper.protocol.messages import TickReport
from dualbrain.control.recording.trace import Event
from dualbrain.records import Attempt, Episode, Scene
from dualbrain.robots.model import RobotModel
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.plant.render_meshes import link_meshes, object_meshes
from dualbrain.visualization.live.operator.instruction_field import LineTone, SubmitCallback
from dualbrain.visualization.live.operator_buttons import OperateCallback, OperatorAccess
from dualbrain.visualization.live.state_builder import StateBuilder, Tick, tick_of_result
from dualbrain.visualization.live.view import FRAME_RATE_HZ, LiveView
from dualbrain.visualization.live.view_state import ViewState

MAX_LINES = 12
MIN_PERIOD_S = 0.9 / FRAME_RATE_HZ
"""Time [s] between two shown ticks; less than a period of the view, because the reports of a gatekeeper jitter."""


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
        has a field for instructions, see `LiveView`.
        """
        self._robot_model, self._plant, self._states = robot_model, plant, StateBuilder(robot_model)
        code = secrets.token_urlsafe(9)
        access = OperatorAccess(operate, code) if operate is not None else None
        self.view = LiveView(
            robot_model,
            port,
            instruction=instruction,
            access=access,
            link_meshes=link_meshes(plant),
            object_meshes=object_meshes(plant),
            submit=submit,
        )
        self._lines: deque[str] = deque(maxlen=MAX_LINES)
        self._contract: Contract | None = None
        self._step = 0
        self._shown_at = -inf
        self._shown: ViewState | None = None
        self._console = console
        if self.view.notice:
            console.print(f"[yellow]{self.view.notice}[/]")
        console.print(f"live view: [bold]{self.view.url}[/]")
        if access:
            console.print(
                f"buttons: the emergency stop needs no code; all others need the operator code [bold]{code}[/]"
            )

    def follow(self, plant: Plant) -> None:
        """Show another run of the same robot from now on; averages begin again."""
        self._plant, self._states = plant, StateBuilder(self._robot_model)
        self._lines.clear()
        self._contract, self._step, self._shown_at = None, 0, -inf

    def show_at_rest(self, scene: Scene) -> None:
        """Show the plant and a perceived `scene` before the first run."""
        self.view.show(ViewState(t=0.0, frames=self._plant.link_poses(), scene=scene))

    def show_line(self, text: str, tone: LineTone = "plain") -> None:
        """Show a line below the field for instructions, if there is one."""
        if self.view.instruction_field is not None:
            self.view.instruction_field.show_line(text, tone)

    def close(self) -> None:
        """Close the page."""
        self.view.close()

    def on_event(self, event: Event) -> None:
        """Show an event as a line of text, and mark the step of the contract that it begins or ends."""
        if event.kind != "perception":
            self._lines.append(f"{event.t:.1f} s  {event.text}")
        if event.kind == "action" and isinstance(index := event.data.get("index"), int):
            self._step = index
            self._states.begin_step(index)
        elif event.kind == "action" and event.data.get("status") == "done":
            self._states.begin_step(self._step + 1)

    def on_attempt(self, attempt: Attempt) -> None:
        """Show the steps of an accepted contract from the next tick on."""
        if isinstance(attempt.verdict, Accepted):
            self._contract, self._step = attempt.verdict.contract, 0

    def on_tick(self, moment: TickSnapshot) -> None:
        """Show a tick of the control loop."""
        tick = tick_of_result(
            moment.state,
            moment.scene,
            moment.result,
            in_contract=moment.action >= 0,
            skill=moment.skill,
            phase=moment.nominal.phase,
            action=moment.decision.action.name,
            check=moment.decision.check,
        )
        if self._is_due(tick):
            self._show(tick)

    def on_tick_report(self, report: TickReport) -> None:
        """Show a tick of a gatekeeper's control loop, received over the socket."""
        tick = Tick(
            t=report.t,
            scene=report.scene,
            q=np.array(report.q),
            opening=report.opening,
            u=np.array(report.u),
            u_nom=np.array(report.u_nom),
            delta=report.delta,
            h_min=nan if report.h_min is None else report.h_min,
            status=report.status,
            barriers=report.barriers,
            pairs=report.pairs,
            in_contract=report.in_contract,
            skill=report.skill,
            phase=report.phase,
            action=report.order,
            check=report.check,
        )
        if self._is_due(tick):
            self._plant.set_configuration(tick.q, tick.opening)
            self._show(tick, is_periodic=True)

    def end_reports(self) -> None:
        """Keep the last state on the page: the gatekeeper ends, and reports no further tick."""
        if self._shown is not None and self._shown.is_periodic:
            self._shown = replace(self._shown, is_periodic=False)
            self.view.show(self._shown)

    def _is_due(self, tick: Tick) -> bool:
        """Count δ of `tick`; whether the view draws it, because a frame has passed since the last one."""
        if tick.in_contract:
            self._states.count(tick.delta)
        return not 0.0 <= tick.t - self._shown_at < MIN_PERIOD_S

    def _show(self, tick: Tick, *, is_periodic: bool = False) -> None:
        self._shown_at = tick.t
        if self._contract is not None:
            self._states.set_plan(self._contract.action_sequence, tick.scene, tick.q)
            self._states.begin_step(self._step)
            self._contract = None
        state = self._states.build(tick, self._plant.link_poses(), tuple(self._lines))
        self._shown = replace(state, is_periodic=is_periodic)
        self.view.show(self._shown)

    def finish(self, episode: Episode, *, stay: bool) -> None:
        """Show the result; with `stay` and a terminal, keep the page open until Ctrl-C."""
        self.view.finish(episode)
        if stay and sys.stdin.isatty():
            self._console.print("The live view stays open. Ctrl-C closes it.")
            try:
                while True:
                    time.sleep(0.5)
            except KeyboardInterrupt:
                pass
        self.view.close()
