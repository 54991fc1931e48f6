"""Strip chart of a run as SVG: contract, clearance, intervention and speed on one time axis."""

from __future__ import annotations

from collections.abc import Mapping
from io import StringIO
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dualbrain.control.recording.trace import DEAD_BAND, Trace
from dualbrain.records import ActionResult, Episode
from dualbrain.visualization.html.page import Html
from dualbrain.visualization.html.plot_style import (
    AMBER,
    BLUE,
    CARD,
    FAINT,
    MATPLOTLIB_STYLE,
    MUTED,
    ORANGE,
    RED,
    ROSE,
    SKY,
    TEXT,
    apply_page_theme,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

MAX_BUCKETS = 900
"""A curve is drawn with the least and the greatest value in each of at most this many time intervals."""

CHART_WIDTH_PT = 10.4 * 72 * 0.93
"""Width of the drawing area [points]."""

STATUS_COLOURS: Mapping[str, str] = {
    "done": BLUE,
    "failed": RED,
    "taken_over": ORANGE,
    "stopped": RED,
    "not_run": MUTED,
}


def min_max_downsample(t: Array, y: Array, buckets: int = MAX_BUCKETS) -> tuple[Array, Array]:
    """`y(t)` reduced to the least, the greatest and a missing value of each bucket, so that peaks and gaps remain."""
    if len(t) <= 2 * buckets:
        return t, y
    edges = np.linspace(0, len(t), buckets + 1).astype(int)
    found = [first + one for first, end in pairwise(edges) for one in _extremes(y[first:end])]
    kept = np.unique([0, *found, len(t) - 1])
    return t[kept], y[kept]


def _extremes(part: Array) -> tuple[int, ...]:
    """Indices of the least and of the greatest value of `part`, and of a NaN if there is one."""
    missing = np.isnan(part)
    extremes = (int(np.where(missing, np.inf, part).argmin()), int(np.where(missing, -np.inf, part).argmax()))
    return (*extremes, int(missing.argmax())) if missing.any() else extremes


def strip_chart(episode: Episode, trace: Trace) -> Html:
    """Chart of four or more strips over one time axis [s]; ticks with an intervention are shaded in all strips."""
    from matplotlib import rc_context  # noqa: PLC0415  (heavy imports are lazy)
    from matplotlib.figure import Figure  # noqa: PLC0415
    from matplotlib.ticker import MaxNLocator  # noqa: PLC0415

    with rc_context(MATPLOTLIB_STYLE):
        speeds = _speed_strips(trace)
        height = 7.7 + 1.7 * (len(speeds) - 1)
        figure = Figure(figsize=(10.4, height))
        rows = figure.subplots(3 + len(speeds), 1, sharex=True, height_ratios=(1.0, 2.2, 1.5, *[1.7] * len(speeds)))
        margins = {"top": 1.0 - 0.038 * 7.7 / height, "bottom": 0.062 * 7.7 / height}
        figure.subplots_adjust(left=0.062, right=0.992, hspace=0.42, **margins)
        rows[0].set_xlim(_time_limits(trace))
        _draw_contract(rows[0], episode, trace)
        _draw_clearance(rows[1], trace)
        _draw_intervention(rows[2], trace)
        for axes, speed in zip(rows[3:], speeds, strict=True):
            _draw_speed(axes, trace, speed)
        for axes in rows:
            axes.tick_params(length=3, labelbottom=axes is rows[-1])
        rows[0].tick_params(length=0)
        rows[-1].xaxis.set_major_locator(MaxNLocator(12, steps=[1, 2, 5, 10]))
        rows[-1].set_xlabel("time [s]", loc="right", labelpad=2)
        out = StringIO()
        figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None})
    return apply_page_theme(out.getvalue(), "contract, clearance, intervention and speed over time")


def _time_limits(trace: Trace) -> tuple[float, float]:
    t = trace["t"]
    return float(t[0]), float(max(t[-1], t[0] + 0.01))


def _draw_title(axes: Axes, title: str, unit: str, *keys: tuple[str, str]) -> None:
    """Draw a left-aligned title with its unit, and on the right the names of the curves in their colours."""
    axes.text(-0.0, 1.06, title, transform=axes.transAxes, fontweight="bold", fontsize=9.5)
    axes.annotate(
        f"{unit}",
        (0, 1.06),
        xycoords="axes fraction",
        xytext=(len(title) * 6.15 + 8, 0),
        textcoords="offset points",
        color=MUTED,
    )
    offset = 0.0
    for name, colour in reversed(keys):
        axes.annotate(
            name,
            (1, 1.06),
            xycoords="axes fraction",
            xytext=(-offset, 0),
            textcoords="offset points",
            color=colour,
            ha="right",
        )
        offset += len(name) * 5.5 + 14


def _shade_interventions(axes: Axes, trace: Trace) -> None:
    """Shade the interventions; interventions that are less than a pixel apart are merged."""
    first, last = _time_limits(trace)
    pixel, joined = (last - first) / MAX_BUCKETS, []
    for span in trace.interventions():
        if joined and span.start - joined[-1][1] < pixel:
            joined[-1][1] = span.end
        else:
            joined.append([span.start, max(span.end, span.start + pixel)])
    for start, end in joined:
        axes.axvspan(start, end, color=AMBER, linewidth=0, zorder=0)


def _draw_contract(axes: Axes, episode: Episode, trace: Trace) -> None:
    _draw_title(axes, "Contract", "actions, and their phases")
    axes.set_ylim(0, 2)
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)
    for index, action in enumerate(episode.outcome.actions):
        if action.status != "not_run":
            colour = STATUS_COLOURS[action.status]
            _draw_bar(axes, (action.started, action.ended), _action_name(episode, index, action), colour)
    for span in trace.spans("phase"):
        _draw_bar(axes, (span.start, span.end), trace.phases[span.code], FAINT)


def _draw_bar(axes: Axes, times: tuple[float, float], text: str, colour: str) -> None:
    """Draw a bar over `times` [s] with its name, cut to fit; phases are faint and drawn below the actions."""
    low, height, letter, text_colour, weight = (0.12, 0.74, 4.4, MUTED, "normal")
    if colour != FAINT:
        low, height, letter, text_colour, weight = (0.98, 0.92, 5.4, CARD, "bold")
    (start, end), (left, right) = times, axes.get_xlim()
    name = _truncate_to_width(text, (end - start) / (right - left) * CHART_WIDTH_PT - 6, letter)
    axes.broken_barh([(start, end - start)], (low, height), facecolor=colour, edgecolor=CARD, linewidth=1.4)
    middle = ((start + end) / 2, low + height / 2 - 0.02)
    axes.text(*middle, name, ha="center", va="center", color=text_colour, fontweight=weight, fontsize=8.3, clip_on=True)


def _truncate_to_width(text: str, width: float, letter: float) -> str:
    """`text` cut to `width` points at `letter` points per character; empty if fewer than four characters fit."""
    room = int(width / letter)
    return text if len(text) <= room else f"{text[: room - 1]}…" if room >= 4 else ""


def _action_name(episode: Episode, index: int, action: ActionResult) -> str:
    """The skill with the object or place that the contract names, and the status if the action is not done."""
    sequence: list[dict[str, Any]] = (episode.contract or {}).get("action_sequence", [])
    params: dict[str, Any] = sequence[index].get("params", {}) if index < len(sequence) else {}
    named = next((str(params[key]) for key in ("object", "target", "place", "destination", "on") if key in params), "")
    mark = "" if action.status == "done" else f" · {action.status.replace('_', ' ')}"
    return " ".join(filter(None, (action.skill, named))) + mark


def _draw_clearance(axes: Axes, trace: Trace) -> None:
    t, h = min_max_downsample(trace["t"], np.where(np.isfinite(trace["h_min"]), 1e3 * trace["h_min"], np.nan))
    _draw_title(
        axes, "Clearance h_min", "mm, least over all rows of the filter", ("intervention", ORANGE), ("least", RED)
    )
    _shade_interventions(axes, trace)
    axes.grid(axis="y")
    axes.plot(t, h, color=BLUE, linewidth=1.3)
    least = float(np.nanmin(h)) if np.isfinite(h).any() else 0.0
    top = float(np.nanmax(h)) if np.isfinite(h).any() else 1.0
    axes.set_ylim(min(-0.04 * top, 1.15 * least), max(1.08 * top, 1.0))
    axes.axhline(0, color=TEXT, linewidth=1.1)
    axes.axhspan(axes.get_ylim()[0], 0, facecolor=ROSE, linewidth=0, zorder=0)
    _mark_min_clearance(axes, trace)


def _mark_min_clearance(axes: Axes, trace: Trace) -> None:
    """Mark the least clearance during the actions, which is the h_min of the outcome."""
    t, h = trace["t"], np.where((trace["action"] >= 0) & np.isfinite(trace["h_min"]), 1e3 * trace["h_min"], np.nan)
    if not np.isfinite(h).any():
        return
    tick = int(np.nanargmin(h))
    at, least = float(t[tick]), float(h[tick])
    left, right = _time_limits(trace)
    side, shift = ("right", -9) if at > (left + right) / 2 else ("left", 9)
    axes.plot([at], [least], "o", color=RED, markersize=4.5, markeredgewidth=0, clip_on=False)
    axes.annotate(
        f"{least:.2f} mm at {at:.2f} s",
        (at, least),
        xytext=(shift, 8),
        textcoords="offset points",
        color=RED,
        ha=side,
        fontweight="bold",
        bbox={"boxstyle": "round,pad=0.25", "facecolor": CARD, "edgecolor": "none", "alpha": 0.85},
    )


def _draw_intervention(axes: Axes, trace: Trace) -> None:
    _draw_title(
        axes,
        "Intervention δ",
        "share of full speed, by cause",
        ("safety rows", RED),
        ("actuator box", SKY),
        ("supervisor", MUTED),
    )
    _shade_interventions(axes, trace)
    axes.grid(axis="y")
    for name, colour in (("delta_rows", RED), ("delta_box", SKY), ("delta_supervisor", MUTED)):
        t, y = min_max_downsample(trace["t"], np.nan_to_num(trace[name], nan=2.0))
        axes.fill_between(t, y, color=colour, alpha=0.22, linewidth=0)
        axes.plot(t, y, color=colour, linewidth=1.2)
    peak = float(np.nan_to_num(trace["delta"], nan=2.0).max())
    axes.set_ylim(0, max(1.12 * peak, 10 * DEAD_BAND))
    if peak <= DEAD_BAND:
        note = f"never above {DEAD_BAND:g}: the filter did not change the nominal control"
        axes.text(0.5, 0.45, note, transform=axes.transAxes, ha="center", color=MUTED)


class SpeedStrip(NamedTuple):
    """A strip of speeds from `columns` of u: a single column with its sign, several columns as their norm."""

    title: str
    unit: str
    columns: slice


JOINT_SPEED_STRIP = SpeedStrip("Joint speed", "rad/s, Euclidean norm", slice(None))
BASE_SPEED_STRIPS = (
    SpeedStrip("Driving", "m/s, forward", slice(0, 1)),
    SpeedStrip("Turning", "rad/s, to the left", slice(1, 2)),
)


def _speed_strips(trace: Trace) -> tuple[SpeedStrip, ...]:
    """Speed strips of a robot: the joint speed of an arm; v and ω of a base, then the joint speed of its arm.

    A base is recognised by its configuration, which has one coordinate more than u.
    """
    if trace.width == trace.n:
        return (JOINT_SPEED_STRIP,)
    return (
        (*BASE_SPEED_STRIPS, JOINT_SPEED_STRIP._replace(columns=slice(2, None)))
        if trace.n > len(BASE_SPEED_STRIPS)
        else BASE_SPEED_STRIPS
    )


def _draw_speed(axes: Axes, trace: Trace, speed: SpeedStrip) -> None:
    signed = speed.columns.stop is not None
    keys = (("nominal", MUTED), ("written", BLUE)) if signed else (("nominal |u_nom|", MUTED), ("written |u|", BLUE))
    _draw_title(axes, speed.title, speed.unit, *keys)
    _shade_interventions(axes, trace)
    axes.grid(axis="y")
    for name, colour, dash in (("u_nom", MUTED, (0, (3, 2))), ("u", BLUE, "solid")):
        part = trace[name][:, speed.columns]
        t, y = min_max_downsample(trace["t"], part[:, 0] if signed else np.linalg.norm(part, axis=1))
        axes.plot(t, y, color=colour, linewidth=1.3, linestyle=dash)
    if not signed:
        axes.set_ylim(0, None)
