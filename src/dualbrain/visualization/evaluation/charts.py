"""Charts of an evaluation as SVG: metrics over repetitions, traces of one case, latency distributions."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import StringIO
from typing import TYPE_CHECKING, Any

import numpy as np

from dualbrain.control.recording.trace import DEAD_BAND
from dualbrain.evaluation.analysis.metrics import METRIC_BY_NAME
from dualbrain.evaluation.analysis.statistics import Estimate, estimate
from dualbrain.evaluation.report.tables import methods_of, values_by_cluster
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.visualization.html.page import Html
from dualbrain.visualization.html.strip_chart import (
    BLUE,
    GREEN,
    MATPLOTLIB_STYLE,
    MUTED,
    ORANGE,
    RED,
    SKY,
    TEXT,
    VIOLET,
    apply_page_theme,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LINE_COLOURS = (BLUE, ORANGE, GREEN, RED, VIOLET, TEXT, SKY, MUTED)
DASHES = ("solid", (0, (4, 2)), (0, (1, 1.5)))
MARKERS = "osD^vP<X>"
MAX_CLEARANCE_MM = 60.0
"""Larger clearances are drawn at this value [mm]."""
DODGE_WIDTH = 0.6
"""Width over which the methods are spread at each repetition, as a share of the distance between repetitions."""
CURVE_METRICS = ("success", "violation rate", "Δ of successes", "intervention frequency")
MAX_RATIO_FOR_MINOR_TICKS = 100.0
"""Beyond this ratio of its ends a logarithmic axis is labelled at powers of ten only."""


def group_methods(methods: Sequence[str]) -> list[list[str]]:
    """Groups of methods that share a figure: all methods, or if these are too many, each method with its variants."""
    if len(methods) <= len(MARKERS):
        return [list(methods)]
    leads = dict.fromkeys(name.partition("-")[0] for name in methods)
    found: list[list[str]] = [[]]
    for lead in leads:
        variants = [name for name in methods if name.partition("-")[0] == lead]
        if found[-1] and len(found[-1]) + len(variants) > len(MARKERS):
            found.append([])
        found[-1] += variants
    return found


def line_style(index: int) -> dict[str, Any]:
    """Colour and dash of method number `index`; all pairs differ, and neighbours differ in both."""
    return {"color": LINE_COLOURS[index % len(LINE_COLOURS)], "linestyle": DASHES[index % len(DASHES)]}


@contextmanager
def _canvas(rows: int, columns: int, height: float, parts: int = 1) -> Iterator[tuple[list[tuple[Any, Any]], StringIO]]:
    """`parts` figures below each other, each with its axes, and the text buffer that receives the SVG on exit."""
    import matplotlib as mpl  # noqa: PLC0415  (heavy imports are lazy)
    from matplotlib.figure import Figure  # noqa: PLC0415

    out = StringIO()
    with mpl.rc_context(MATPLOTLIB_STYLE):
        whole = Figure(figsize=(10.4, height * parts))
        figures = list(whole.subfigures(parts, 1, squeeze=False).flat)
        axes = [figure.subplots(rows, columns, squeeze=False) for figure in figures]
        for figure in figures:
            figure.subplots_adjust(left=0.06, right=0.99, top=0.90, bottom=0.12, hspace=0.55, wspace=0.22)
        yield list(zip(figures, axes, strict=True)), out
        whole.savefig(out, format="svg", metadata={"Date": None, "Creator": None})


def metrics_chart(rows: Sequence[EpisodeRow]) -> Html:
    """Chart of the main metrics over the repetitions of a scene, by method, with intervals."""
    groups = group_methods(methods_of(rows))
    with _canvas(2, 2, 6.0, len(groups)) as (figures, out):
        for methods, (figure, axes) in zip(groups, figures, strict=True):
            for place, name in zip(axes.flat, CURVE_METRICS, strict=True):
                _set_title(place, name, "over repetitions")
                _draw_metric(place, rows, methods, name)
            _add_legend(figure, methods, marked=True)
    return apply_page_theme(out.getvalue(), "metrics over repetitions")


def _draw_metric(axes: Axes, rows: Sequence[EpisodeRow], methods: Sequence[str], name: str) -> None:
    from matplotlib.ticker import MaxNLocator  # noqa: PLC0415

    for index, method in enumerate(methods):
        _draw_curve(axes, rows, method, name, index, DODGE_WIDTH * ((index + 0.5) / len(methods) - 0.5))
    axes.set_ylim(0, None)
    axes.set_xlabel("repetition", loc="right", labelpad=1)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))


def _draw_curve(axes: Axes, rows: Sequence[EpisodeRow], method: str, name: str, index: int, dodge: float) -> None:
    """Means with their intervals, shifted by `dodge` repetitions so that equal methods remain visible."""
    mine = [row for row in rows if row.method == method]
    points = [(k, _estimate_at(mine, k, name)) for k in sorted({row.repetition for row in mine})]
    known = [(k, found) for k, found in points if found.n]
    if not known:
        return
    x = np.array([k for k, _ in known], float) + 1.0 + dodge
    means, low, high = (np.array([getattr(found, part) for _, found in known]) for part in ("mean", "low", "high"))
    axes.plot(x, means, linewidth=1.0, marker=MARKERS[index % len(MARKERS)], markersize=4.2, **line_style(index))
    fine = np.isfinite(low) & np.isfinite(high)
    axes.vlines(x[fine], low[fine], high[fine], color=line_style(index)["color"], alpha=0.45, linewidth=0.9)


def _estimate_at(rows: Sequence[EpisodeRow], repetition: int, name: str) -> Estimate:
    metric = METRIC_BY_NAME[name]
    here = [row for row in rows if row.repetition == repetition]
    return estimate(values_by_cluster(here, metric), is_rate=metric.unit == "rate")


def traces_chart(rows: Sequence[EpisodeRow]) -> Html:
    """Chart of the least h and the largest δ over time, for a case that most methods ran; δ is 0 without a filter.

    Methods with identical results share a line; × marks the start of a violation.
    """
    pair = select_traced_pair(rows)
    here = {row.method: row for row in rows if row.pair == pair and row.trace_t}
    groups = group_methods(methods_of(rows))
    with _canvas(2, 1, 4.9, len(groups)) as (figures, out):
        for methods, (figure, axes) in zip(groups, figures, strict=True):
            figure.subplots_adjust(top=0.87)
            groups_of_equals = group_identical(here, methods)
            _draw_traces(axes.flat, here, groups_of_equals)
            _add_legend(figure, [" = ".join(names) for names in groups_of_equals])
    return apply_page_theme(out.getvalue(), f"h_min and δ over time, {pair}")


def group_identical(rows: Mapping[str, EpisodeRow], methods: Sequence[str]) -> list[list[str]]:
    """The `methods` that have a row in `rows`, grouped by identical curves and violations."""
    found: dict[Any, list[str]] = {}
    for name in methods:
        if name in rows:
            row = rows[name]
            result = (*row.trace_t, *row.trace_h, *row.trace_delta, row.violations)
            found.setdefault(result, []).append(name)
    return list(found.values())


def _draw_traces(axes: Iterable[Axes], here: Mapping[str, EpisodeRow], groups: Sequence[Sequence[str]]) -> None:
    above, below = axes
    _set_title(above, "Clearance h_min", "mm, least in each tenth of a second")
    _set_title(below, "Intervention δ", "share of full speed, largest in each tenth of a second")
    for index, names in enumerate(groups):
        row, style = here[names[0]], line_style(index)
        t, h = np.array(row.trace_t), np.minimum(1e3 * np.array(row.trace_h), MAX_CLEARANCE_MM)
        above.plot(t, h, linewidth=1.2, **style)
        below.plot(t, row.trace_delta, linewidth=1.2, **style)
        starts = [violation.start for violation in row.violations]
        above.plot(starts, np.interp(starts, t, h), linestyle="none", marker="x", markersize=6, color=style["color"])
    if not groups:
        above.text(0.5, 0.5, "no traces in this table", transform=above.transAxes, ha="center", color=MUTED)
    above.axhline(0, color=TEXT, linewidth=1.0)
    below.set_ylim(0, None)
    below.axhline(DEAD_BAND, color=MUTED, linewidth=0.6)
    for one in (above, below):
        one.set_xlabel("time [s]", loc="right", labelpad=1)


def select_traced_pair(rows: Sequence[EpisodeRow]) -> str:
    """The case that is drawn: of those in which most methods moved, the one with the most violations; "" if none."""
    moved: dict[str, set[str]] = {}
    n_violations: dict[str, int] = {}
    for row in rows:
        if row.trace_t:
            moved.setdefault(row.pair, set()).add(row.method)
            n_violations[row.pair] = n_violations.get(row.pair, 0) + len(row.violations)
    return max(sorted(moved), key=lambda pair: (len(moved[pair]), n_violations[pair]), default="")


def latencies_chart(rows: Sequence[EpisodeRow], decision_times: Sequence[float]) -> Html:
    """Cumulative distributions of `decision_times` [s], of the gate time and of the time of a filter step."""
    gate = [1e3 * row.gate_s for row in rows if row.shots]
    steps = [row.filter_us for row in rows if row.filter_us]
    with _canvas(1, 3, 2.8) as (((figure, axes),), out):
        figure.subplots_adjust(top=0.82, bottom=0.23, right=0.97)
        _draw_cumulative(axes[0, 0], "Decision", "single requests", "s", {"planner": decision_times})
        _draw_cumulative(axes[0, 1], "Gate", "all shots", "ms", {"gate": gate})
        parts = {name: [one[k] for one in steps] for k, name in enumerate(("median", "p99", "worst"))}
        _draw_cumulative(axes[0, 2], "Filter step", "of each episode", "µs", parts)
        axes[0, 0].set_ylabel("share of measurements below", fontsize=8)
    return apply_page_theme(out.getvalue(), "latency distributions")


def _draw_cumulative(axes: Axes, title: str, subtitle: str, unit: str, parts: Mapping[str, Sequence[float]]) -> None:
    """Cumulative shares on a logarithmic axis in `unit`."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter  # noqa: PLC0415

    _set_title(axes, title, subtitle)
    drawn = False
    for index, (name, values) in enumerate(parts.items()):
        known = np.sort([value for value in values if value > 0.0])
        if len(known):
            axes.step(known, np.arange(1, len(known) + 1) / len(known), where="post", label=name, **line_style(index))
            drawn = True
    if not drawn:
        axes.text(0.5, 0.5, "not measured", transform=axes.transAxes, ha="center", color=MUTED)
        axes.set_xticks([])
        return
    axes.set_xlabel(f"time [{unit}]", loc="right", labelpad=1)
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0,) if high > MAX_RATIO_FOR_MINOR_TICKS * low else (1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_ylim(0, 1.02)
    if len(parts) > 1:
        axes.legend(frameon=False, fontsize=8)


def _set_title(axes: Axes, title: str, subtitle: str) -> None:
    axes.set_title(title, loc="left", fontsize=9.5, fontweight="bold", color=TEXT)
    axes.set_title(subtitle, loc="right", fontsize=8, color=MUTED)
    axes.grid(axis="y")


def _add_legend(figure: Any, shown: Sequence[str], *, marked: bool = False) -> None:
    """Legend above a figure, in the order of the line styles."""
    from matplotlib.lines import Line2D  # noqa: PLC0415

    marks = [MARKERS[k % len(MARKERS)] if marked else "" for k in range(len(shown))]
    lines = [
        Line2D([], [], linewidth=1.6, marker=mark, markersize=4.2, **line_style(k)) for k, mark in enumerate(marks)
    ]
    figure.legend(lines, shown, loc="upper center", ncol=len(shown) or 1, frameon=False, fontsize=8.5, handlelength=2.6)
