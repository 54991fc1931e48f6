"""The plot of experiment `learning`: Δ, decision time and weights over repetitions."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dualbrain.visualization.html.plot_style import image_figure, light_colours
from experiments.engine.experiment import Row

COLOUR_NAMES = {"dynamic": "blue", "static": "orange"}
REFUSED_MARK_HEIGHT = {"dynamic": 0.03, "static": 0.08}
"""Height of the mark of a rejected contract above the lower edge [share of the axis]."""


def plot_learning(rows: list[Row], path: Path) -> None:
    """Draw thin lines for ledgers, thick lines for their medians, crosses for rejected contracts (without motion).

    The page of the experiment names the ledgers.
    """
    colours = light_colours()
    by_arm = {arm: colours[name] for arm, name in COLOUR_NAMES.items()}
    with image_figure(path, 9.0) as figure:
        axes = figure.subplots(3, 1)
        for name, axis, label in (("Delta", axes[0], "Δ of the episode"), ("decision_s", axes[1], "decision time [s]")):
            for arm, colour in by_arm.items():
                lines = [_values(row, name) for row in rows if row["arm"] == arm]
                for line in lines:
                    axis.plot(line, color=colour, alpha=0.2, lw=0.8)
                if lines:
                    shortest = min(map(len, lines))
                    known = np.ma.masked_invalid([line[:shortest] for line in lines])
                    axis.plot(
                        np.ma.median(known, axis=0), color=colour, lw=2.2, label=f"{arm} weights ({len(lines)} ledgers)"
                    )
            axis.set_ylabel(label)
            axis.legend()
        axes[0].set_yscale("symlog", linthresh=1e-3)
        for row in rows:
            rejected = np.flatnonzero(np.isnan(_values(row, "Delta")))
            transform, colour = axes[0].get_xaxis_transform(), by_arm[row["arm"]]
            axes[0].plot(
                rejected,
                np.full(len(rejected), REFUSED_MARK_HEIGHT[row["arm"]]),
                "x",
                color=colour,
                alpha=0.5,
                transform=transform,
            )
        for row in rows:
            if row["arm"] == "dynamic":
                curve = np.array(row["parted"])
                axes[2].plot(curve[:, 0], curve[:, 1], color=colours["green"], alpha=0.6, lw=1.0)
                axes[2].plot(curve[:, 0], curve[:, 2], color=colours["red"], alpha=0.6, lw=1.0)
        axes[2].set_ylabel("mean weight w")
        axes[2].set_xlabel("event in the ledger (green: memories of low Δ and success; red: all others)")
        axes[1].set_xlabel("repetition of the scene")


def _values(row: Row, name: str) -> np.ndarray:
    found = [one[name] for one in row["episodes"]]
    return np.array([np.nan if value is None else value for value in found])
