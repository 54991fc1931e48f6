"""The plot of experiment `tick`: the intervals between ticks, and the parts of a tick."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from dualbrain.control.gatekeeper.timing.tick_profile import TICK_PARTS
from dualbrain.control.gatekeeper.timing.tick_timing import BIN_FRACTION
from dualbrain.safety.supervisor.timing import SIMULATED
from dualbrain.visualization.html.plot_style import image_figure, light_colours
from experiments.engine.experiment import Row

BLUE, ORANGE = light_colours()["blue"], light_colours()["orange"]
MAX_SHOWN_INTERVAL = 6e-3
"""Largest interval with its own column [s]; longer ones are in the last column."""


def plot_tick(row: Row, path: Path) -> None:
    """Draw the counts of intervals, logarithmic, and the mean and 99th percentile of each part of a tick."""
    with image_figure(path, 4.0) as figure:
        left, right = figure.subplots(1, 2, width_ratios=(1.4, 1.0))
        _intervals(left, row)
        _parts(right, row["parts"])


def _intervals(axis: Axes, row: Row) -> None:
    width = BIN_FRACTION * SIMULATED.period
    last = int(MAX_SHOWN_INTERVAL / width)
    counts = np.zeros(last + 1)
    for k, count in row["bins"].items():
        counts[min(int(k), last)] += count
    axis.bar(1e3 * width * (np.arange(last + 1) + 0.5), counts, width=1e3 * width, color=BLUE)
    axis.axvline(1e3 * SIMULATED.period, color="0.3", lw=0.8, ls="--")
    axis.set_yscale("log")
    axis.set_xlabel(f"interval between two joint states [ms] (longest {1e3 * row['interval'][3]:.1f} ms)")
    axis.set_ylabel(f"of {row['ticks']} states")


def _parts(axis: Axes, parts: dict) -> None:
    names = [name for name in TICK_PARTS if name != "wait" and parts[name]["ticks"]][::-1]
    means = [1e6 * parts[name]["mean"] for name in names]
    late = [1e6 * parts[name]["quantiles"][1] for name in names]
    axis.barh(names, late, color=ORANGE, alpha=0.35, label="99 %")
    axis.barh(names, means, color=BLUE, height=0.45, label="mean")
    axis.set_xlabel("µs of a tick")
    axis.legend()
