"""Charts of an evaluation as SVG: metrics over repetitions, traces of one case, latency distributions."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import StringIO
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dualbrain.control.recording.trace import DEAD_BAND
from dualbrain.evaluation.analysis.metrics import METRIC_BY_NAME
from dualbrain.evaluation.analysis.statistics import Estimate, estimate
from dualbrain.evaluation.report.tables import estimate_metric, methods_of, values_by_cluster
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.visualization.html.page import Html
from dualbrain.visualization.html.plot_style import (
    BLUE,
    GREEN,
    LINE,
    LINE_COLOURS,
    MATPLOTLIB_STYLE,
    MUTED,
    RED,
    TEXT,
    apply_page_theme,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]
DASHES = ("solid", (0, (4, 2)), (0, (1, 1.5)))
MAX_GROUP = 9
"""Largest number of methods in one figure."""
MAX_CLEARANCE_MM = 60.0
"""Larger clearances are drawn at this value [mm]."""
BAR_TEXT_AT = 1.16
"""Place of the numbers at the right of the bars, as a share."""
SUMMARY_METRICS = (("success", GREEN), ("violation rate", RED))
"""Rates of the first chart, with their colours."""
CURVE_METRICS = ("success", "violation rate", "Δ of successes", "intervention frequency")
MAX_RATIO_FOR_MINOR_TICKS = 100.0
"""Beyond this ratio of its ends a logarithmic axis is labelled at powers of ten only."""


def group_methods(methods: Sequence[str]) -> list[list[str]]:
    """Groups of methods that share a figure: all methods, or if these are too many, each method with its variants."""
    if len(methods) <= MAX_GROUP:
        return [list(methods)]
    leads = dict.fromkeys(name.partition("-")[0] for name in methods)
    found: list[list[str]] = [[]]
    for lead in leads:
        variants = [name for name in methods if name.partition("-")[0] == lead]
        if found[-1] and len(found[-1]) + len(variants) > MAX_GROUP:
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


def summary_chart(rows: Sequence[EpisodeRow]) -> Html:
    """Chart with one bar per method for each of the main rates, with its interval; methods below each other."""
    methods = methods_of(rows)
    height = 0.9 + 0.27 * len(methods)
    with _canvas(1, len(SUMMARY_METRICS), height) as (((figure, axes),), out):
        figure.subplots_adjust(left=0.09, right=0.99, top=1.0 - 0.4 / height, bottom=0.32 / height, wspace=0.1)
        for place, (name, colour) in zip(axes.flat, SUMMARY_METRICS, strict=True):
            _draw_bars(place, rows, methods, name, colour)
            place.tick_params(axis="y", length=0, labelleft=place is axes.flat[0], labelsize=9, labelcolor=TEXT)
    return apply_page_theme(out.getvalue(), "success and violations by method")


def _draw_bars(axes: Axes, rows: Sequence[EpisodeRow], methods: Sequence[str], name: str, colour: str) -> None:
    from matplotlib.ticker import PercentFormatter  # noqa: PLC0415

    axes.set_title(name, loc="left", fontsize=9.5, fontweight="bold", color=TEXT)
    axes.set_title("share of episodes, 95 %", loc="right", fontsize=8, color=MUTED)
    for place, method in enumerate(methods):
        found = estimate_metric(rows, method, name)
        if not found.n:
            axes.text(0.01, place, "not measured", va="center", fontsize=8, color=MUTED)
            continue
        axes.barh(place, found.mean, height=0.62, color=colour, alpha=0.8)
        if np.isfinite(found.low + found.high):
            axes.plot((found.low, found.high), (place, place), color=TEXT, linewidth=1.1, solid_capstyle="butt")
        axes.text(BAR_TEXT_AT, place, f"{100.0 * found.mean:.1f} %", va="center", ha="right", fontsize=8.5, color=TEXT)
    axes.set_xlim(0.0, BAR_TEXT_AT)
    axes.set_xticks(np.linspace(0.0, 1.0, 6))
    axes.set_ylim(len(methods) - 0.45, -0.55)
    axes.set_yticks(range(len(methods)), methods)
    axes.xaxis.set_major_formatter(PercentFormatter(1.0, symbol=" %"))
    axes.grid(axis="x")
    axes.set_axisbelow(True)


def metrics_chart(rows: Sequence[EpisodeRow]) -> Html:
    """Chart of the main metrics over the repetitions of a scene: one small panel for each metric and method.

    The intervals are those of the method of the panel; the other methods of the figure are thin lines behind it.
    """
    groups = group_methods(methods_of(rows))
    columns = max(map(len, groups))
    with _canvas(len(CURVE_METRICS), columns, 6.4, len(groups)) as (figures, out):
        for methods, (figure, axes) in zip(groups, figures, strict=True):
            figure.subplots_adjust(left=0.075, top=0.93, bottom=0.09, hspace=0.32, wspace=0.14)
            for line, name in zip(axes, CURVE_METRICS, strict=True):
                _draw_panels(line, rows, methods, name)
            for place, method in zip(axes[0], methods, strict=False):
                place.set_title(method, fontsize=9.5, fontweight="bold", color=TEXT)
    return apply_page_theme(out.getvalue(), "metrics over repetitions, a panel for each metric and method")


def _draw_panels(line: Sequence[Axes], rows: Sequence[EpisodeRow], methods: Sequence[str], name: str) -> None:
    """One metric in a panel for each method, all with the same axis; panels without a method remain empty."""
    from matplotlib.ticker import MaxNLocator  # noqa: PLC0415

    curves = [_curve(rows, method, name) for method in methods]
    highest = max((one.highest for one in curves), default=0.0)
    for column, place in enumerate(line):
        if column >= len(methods):
            place.set_visible(False)
            continue
        for other in curves:
            place.plot(other.x, other.mean, color=LINE, linewidth=0.9, zorder=1)
        _draw_curve(place, curves[column])
        place.set_ylim(0.0, 1.06 * highest if highest > 0.0 else 1.0)
        place.grid(axis="y")
        place.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=4, min_n_ticks=1))
        place.yaxis.set_major_locator(MaxNLocator(nbins=4))
        place.tick_params(length=2, labelsize=7.5, labelleft=column == 0, labelbottom=name == CURVE_METRICS[-1])
    line[0].set_ylabel(name.replace(" ", "\n", 1), fontsize=8.5, fontweight="bold", color=TEXT)
    if name == CURVE_METRICS[-1]:
        line[len(methods) - 1].set_xlabel("repetition", loc="right", labelpad=1, fontsize=8)


class _Curve(NamedTuple):
    """Means of one method over the repetitions `x`, with the ends of their intervals (not finite: unknown)."""

    x: Array
    mean: Array
    low: Array
    high: Array

    @property
    def highest(self) -> float:
        """The largest drawn value."""
        return float(np.max(np.r_[0.0, self.mean, self.high[np.isfinite(self.high)]]))


def _curve(rows: Sequence[EpisodeRow], method: str, name: str) -> _Curve:
    mine = [row for row in rows if row.method == method]
    points = [(k, _estimate_at(mine, k, name)) for k in sorted({row.repetition for row in mine})]
    known = [(k + 1.0, found.mean, found.low, found.high) for k, found in points if found.n]
    return _Curve(*np.array(known, float).reshape(-1, 4).T)


def _draw_curve(axes: Axes, curve: _Curve) -> None:
    """The curve of a panel with its intervals."""
    fine = np.isfinite(curve.low) & np.isfinite(curve.high)
    axes.vlines(curve.x[fine], curve.low[fine], curve.high[fine], color=BLUE, alpha=0.45, linewidth=1.4, zorder=2)
    axes.plot(curve.x, curve.mean, color=BLUE, linewidth=1.4, marker="o", markersize=3.2, zorder=3)


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


def _add_legend(figure: Any, shown: Sequence[str]) -> None:
    """Legend above a figure, in the order of the line styles."""
    from matplotlib.lines import Line2D  # noqa: PLC0415

    lines = [Line2D([], [], linewidth=1.6, **line_style(k)) for k in range(len(shown))]
    figure.legend(lines, shown, loc="upper center", ncol=len(shown) or 1, frameon=False, fontsize=8.5, handlelength=2.6)
