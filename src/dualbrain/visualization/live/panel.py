"""Panel of the live view: current numbers, plots of their recent values, verdicts, and the final result."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dualbrain.records import Episode
from dualbrain.robots.model import RobotModel
from dualbrain.visualization.html.key_numbers import (
    format_dimensionless,
    format_millimetres,
    format_seconds,
    key_numbers,
)
from dualbrain.visualization.html.page import Html, element
from dualbrain.visualization.live.operator.operator_status import OperatorState, describe_situation
from dualbrain.visualization.live.view_state import ViewState

if TYPE_CHECKING:
    from viser import GuiApi, GuiUplotHandle

MAX_HISTORY_POINTS = 240
"""Points of the plots: two minutes at the rate of `view.py`."""
MAX_LINES = 8
DETAILS_ORDER = 1e6
"""Place of the details in the panel: at its end."""

NumberRow = tuple[str, str, str]
"""Name in `ViewState.numbers`, label for people, unit."""
NUMBER_ROWS: tuple[NumberRow, ...] = (
    ("phase", "phase", ""),
    ("status", "filter", ""),
    ("barriers", "active barriers", ""),
    ("h_min", "clearance h_min", "mm"),
    ("delta", "δ now", ""),
    ("Delta", "Δ so far", ""),
    ("intervention_frequency", "ticks intervened", "%"),
)
TRAILING_ROWS: tuple[NumberRow, ...] = (("planner", "planner", ""), ("elapsed", "elapsed", "s"))
JOINT_SPEED_ROWS: tuple[NumberRow, ...] = (("speed", "joint speed", "rad/s"),)
BASE_SPEED_ROWS: tuple[NumberRow, ...] = (("drive", "driving", "m/s"), ("turn", "turning", "rad/s"))


def speed_rows(robot_model: RobotModel) -> tuple[NumberRow, ...]:
    """Rows of the commanded speeds of a robot: of its joints, of its base, or of both."""
    return (
        *(BASE_SPEED_ROWS if robot_model.is_mobile else ()),
        *(() if robot_model.is_mobile and not robot_model.is_mobile_manipulator else JOINT_SPEED_ROWS),
    )


def commanded_speeds(robot_model: RobotModel, u: NDArray[np.float64]) -> dict[str, float]:
    """Numbers of the rows of `speed_rows`: v [m/s] and ω [rad/s] of a base, norm of the joint velocities [rad/s]."""
    base = {"drive": float(u[0]), "turn": float(u[1])} if robot_model.is_mobile else {}
    joints = u[2:] if robot_model.is_mobile else u
    return base | ({"speed": float(np.linalg.norm(joints))} if len(joints) else {})


def format_live_number(name: str, value: float | str | None) -> str:
    """A live number as text in the unit of its row."""
    if isinstance(value, str) or value is None:
        return value or "–"
    if np.isnan(value):  # h_min of a rejected input: nothing was measured
        return "–"
    if name == "h_min":
        return format_millimetres(value)
    if name == "intervention_frequency":
        return f"{100 * value:.2f}"
    return format_seconds(value) if name in ("elapsed", "speed", "drive", "turn") else format_dimensionless(value)


def _table_row(identity: str, label: str, text: str, unit: str, **more: str) -> Html:
    shown = element("td", text, *([element("small", unit)] if unit else []), id=identity, **more)
    return element("tr", element("td", label), shown)


def panel_block(*children: str) -> str:
    """A block of the panel, in the style of `web/panel.css`; a plain string, because viser encodes no other."""
    return str(element("div", *children, class_="db"))


def numbers_html(state: ViewState, speeds: tuple[NumberRow, ...] = JOINT_SPEED_ROWS) -> str:
    """Table of the live numbers as HTML."""
    shown = (*NUMBER_ROWS, *speeds, *TRAILING_ROWS)
    rows = (
        _table_row(f"live-{name}", label, format_live_number(name, state.numbers.get(name)), unit)
        for name, label, unit in shown
    )
    return panel_block(element("table", *rows))


def plain_html(state: ViewState) -> str:
    """The numbers for the operator, in plain words, as HTML."""
    situation, h_min = state.situation, state.numbers.get("h_min")
    step = next(
        (f"{k} of {len(state.plan)}: {one.label}" for k, one in enumerate(state.plan, 1) if one.is_current), "–"
    )
    distance = f"{1e3 * h_min:.0f}" if isinstance(h_min, float | int) and np.isfinite(h_min) else "–"
    moves = describe_situation(situation).state in (OperatorState.MOVING, OperatorState.GIVING_WAY)
    speed = f"{100 * min(1.0, situation.speed_share):.0f}" if moves else "–"
    rows = (
        _table_row("plain-step", "step", step, ""),
        _table_row("plain-distance", "to the nearest safety margin", distance, "mm"),
        _table_row("plain-speed", "speed that the filter permits", speed, "%"),
    )
    return panel_block(element("table", *rows))


def lines_html(lines: tuple[str, ...]) -> str:
    """The last `MAX_LINES` lines as HTML, the newest first."""
    return panel_block(element("ul", *(element("li", line) for line in reversed(lines[-MAX_LINES:]))))


def final_html(episode: Episode) -> str:
    """Outcome and key numbers of a finished run as HTML, each with its exact value in `data-value`."""
    outcome = episode.outcome
    rows = (
        _table_row(f"final-{one.name}", one.label, one.text, one.unit, data_value=repr(one.value))
        for one in key_numbers(episode)
    )
    tone = "good" if outcome.kind == "succeeded" else "bad"
    head = element(
        "h4", element("span", outcome.kind.replace("_", " "), class_=tone, id="final-outcome", data_value=outcome.kind)
    )
    return panel_block(head, element("p", outcome.reason), element("table", *rows))


class LivePanel:
    """GUI elements of the panel."""

    _shown_lines: tuple[str, ...]

    def __init__(self, gui: GuiApi, speeds: tuple[NumberRow, ...] = JOINT_SPEED_ROWS) -> None:
        """Add the final result (hidden), numbers, plots and lines; the rows `speeds` are below "details"."""
        self._speeds = speeds
        self._history: deque[tuple[float, float, float]] = deque(maxlen=MAX_HISTORY_POINTS)
        self._instruction = gui.add_html("")
        self._final = gui.add_html("", visible=False)
        self._plain = gui.add_html("")
        self._h = _add_plot(gui, "distance to the nearest safety margin [mm]", {"stroke": "#2f86c6", "width": 1.5})
        self._lines = gui.add_html("")
        self._shown_lines = ()
        with gui.add_folder("details", expand_by_default=False, order=DETAILS_ORDER):
            self._numbers = gui.add_html("")
            filled = {"stroke": "#d0601c", "width": 1.5, "fill": "#d0601c33"}
            self._delta = _add_plot(gui, "intervention δ over time [s]", filled)

    def show_instruction(self, instruction: str) -> None:
        """Show the instruction of the run."""
        self._instruction.content = panel_block(element("h4", f"“{instruction}”"))

    def update(self, state: ViewState) -> None:
        """Show the numbers for the operator and the lines of `state`."""
        self._plain.content = plain_html(state)
        if state.lines != self._shown_lines:
            self._shown_lines = state.lines
            self._lines.content = lines_html(state.lines)

    def update_details(self, state: ViewState) -> None:
        """Show all numbers of `state`, and append its h_min and δ to the plots."""
        self._numbers.content = numbers_html(state, self._speeds)
        h, delta = state.numbers.get("h_min"), state.numbers.get("delta")
        if isinstance(h, float | int) and isinstance(delta, float | int) and np.isfinite((h, delta)).all():
            self._history.append((state.t, 1e3 * h, delta))
        if len(self._history) > 1:
            t, millimetre, magnitude = np.array(self._history).T
            self._h.data, self._delta.data = (t, millimetre), (t, magnitude)
            self._h.visible = self._delta.visible = True

    def finish(self, episode: Episode) -> None:
        """Show the final result in place of the live numbers."""
        self._final.content = final_html(episode)
        self._final.visible, self._numbers.visible, self._plain.visible = True, False, False


def _add_plot(gui: GuiApi, title: str, line: Any) -> GuiUplotHandle:
    """Add a plot over time, which is hidden until it has data: the client keeps the range of an empty plot."""
    empty = np.array([0.0, 1e-3])
    axis: Any = {"stroke": "#888", "size": 40, "grid": {"stroke": "#8882"}, "ticks": {"size": 3, "stroke": "#8884"}}
    time: Any = {**axis, "size": 26}
    return gui.add_uplot(
        (empty, empty),
        ({}, line),
        title=title,
        axes=(time, axis),
        height=130,
        legend={"show": False},
        scales={"x": {"time": False}},
        visible=False,
    )
