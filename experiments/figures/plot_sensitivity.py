"""The plot of the sensitivity sweeps: the Δ of every contract on every seed, by family, at one speed."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import zip_longest
from math import ceil
from pathlib import Path
from statistics import median

from dualbrain.visualization.html.plot_style import LINE_COLOURS, PLACEHOLDER_COLOURS, image_figure, light_colours
from experiments.planning.contract_sensitivity import DELTA_FLOOR, FAILURE_SCORE, FAMILIES, ScoresBySeed

SPEED = 0.2
COLUMNS = 3
"""Number of panels beside each other."""


def plot_sensitivity(
    tables: dict[tuple[str, float], ScoresBySeed], path: Path, speed: float = SPEED, order: Sequence[str] = FAMILIES
) -> None:
    """Draw a panel per family, in `order`: contracts sorted by success and median Δ, failures in a band at the top."""
    shown = [family for family in order if (family, speed) in tables]
    lines = ceil(len(shown) / COLUMNS)
    with image_figure(path, 0.8 + 3.4 * lines) as figure:
        panels = figure.subplots(lines, COLUMNS, sharey=True, squeeze=False)
        for panel, family in zip_longest(panels.flat, shown):
            if family is None:
                panel.set_visible(False)
            else:
                _panel(panel, family, tables[family, speed])
        for line in panels:
            line[0].set_ylabel("Δ of a success (floor 1e-4)")
        figure.suptitle(f"Valid contracts at {speed} m/s: each dot is an episode, each colour a seed")


def _sort_key(values: list[float]) -> tuple[float, float]:
    """Contracts with few failures come first, then those with a small median Δ."""
    good = [value for value in values if value < FAILURE_SCORE]
    return 1.0 - len(good) / len(values), median(good) if good else FAILURE_SCORE


def _panel(panel, family: str, scores: ScoresBySeed) -> None:
    names = sorted({name for line in scores.values() for name in line})
    names.sort(key=lambda name: _sort_key([line[name] for line in scores.values() if name in line]))
    failure_height = 0.3
    names_of_colours = {placeholder: name for name, placeholder in PLACEHOLDER_COLOURS.items()}
    colours = [light_colours()[names_of_colours[one]] for one in LINE_COLOURS]
    for (seed, line), colour in zip(scores.items(), colours * 9, strict=False):
        shift = 0.5 * (list(scores).index(seed) / max(1, len(scores) - 1) - 0.5)
        known = [(place + shift, line[name]) for place, name in enumerate(names) if name in line]
        good = [(x, y) for x, y in known if y < FAILURE_SCORE]
        bad = [x for x, y in known if y == FAILURE_SCORE]
        panel.plot(*zip(*good, strict=True), "o", ms=4, color=colour, label=str(seed)) if good else None
        panel.plot(bad, [failure_height * (1 + 0.25 * shift)] * len(bad), "x", ms=4, color=colour)
    panel.axhspan(0.15, 0.6, color="0.93", zorder=0)
    panel.text(0.01, 0.985, "failed", transform=panel.transAxes, va="top", color="0.35")
    panel.set_yscale("log")
    panel.set_ylim(DELTA_FLOOR * 0.7, 0.6)
    panel.set_xticks(range(0, len(names), 5))
    panel.set_xlabel("contracts, best first")
    panel.set_title(family)
