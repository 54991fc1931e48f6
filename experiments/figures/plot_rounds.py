"""The plot of experiment `rounds`: shares, Δ, intervention and time by round, with their intervals."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dualbrain.visualization.html.plot_style import image_figure
from experiments.adaptation.rounds import METRICS, estimate_metric
from experiments.engine.experiment import Row

PANELS = (
    ("compliant", "correct", "success", "declined if required"),
    ("Δ of successes",),
    ("intervention frequency",),
    ("time to completion [s]",),
)
LINE_OFFSET = 0.05
"""Horizontal offset between the lines of one panel [rounds]."""


def plot_rounds(rows: list[Row], path: Path) -> None:
    """Draw the mean over all episodes of a round as a dot, with the 95 % interval over places as its bar."""
    with image_figure(path, 6.6) as figure:
        numbers = sorted({row["round"] for row in rows})
        for axis, names in zip(figure.subplots(2, 2).flat, PANELS, strict=True):
            for place, name in enumerate(names):
                estimates = [
                    estimate_metric(name, [row for row in rows if row["round"] == number]) for number in numbers
                ]
                mean = np.array([one.mean for one in estimates])
                errors = np.nan_to_num(
                    [[one.mean - one.low for one in estimates], [one.high - one.mean for one in estimates]], posinf=0
                )
                axis.errorbar(
                    np.array(numbers) + LINE_OFFSET * place,
                    mean,
                    np.maximum(errors, 0.0),
                    fmt="o-",
                    capsize=3,
                    lw=1.4,
                    label=name,
                )
            axis.set_xticks(numbers)
            axis.set_xlabel("round (0: the base)")
            axis.set_ylim(bottom=0.0, top=1.02 if METRICS[names[0]].is_share else None)
            if len(names) > 1:
                axis.legend()
            else:
                axis.set_title(names[0])
