"""The memory map: every memory as a point, like ones near each other, coloured by its weight w."""

from __future__ import annotations

from io import StringIO

import numpy as np

from dualbrain.memory.maintenance.projection import MemoryMap
from dualbrain.visualization.html.page import Html, element, section
from dualbrain.visualization.html.strip_chart import AMBER, BLUE, MUTED, RED, SKY, STYLE, themed

SHADES = ((0.2, RED), (0.4, AMBER), (0.6, MUTED), (0.8, SKY), (1.01, BLUE))
"""Weights below each bound are drawn in this colour of the page."""
MOST = 3000
"""Only the newest so many are drawn."""
MARKS = (("succeeded", "o"), ("failed", "X"))
"""Other outcomes are small points."""


def map_section(drawn: MemoryMap, newest: str) -> Html:
    """The map with the memory called `newest` ringed; a sentence where there is nothing to draw."""
    if len(drawn.names) < 3:
        return section("Memory map", element("p", "Too few memories for a map.", class_="muted"))
    told = (
        f"{len(drawn.names)} memories; near means alike. The two axes show {drawn.shown:.0%} of the variance. Circles "
        "succeeded, crosses failed, points are others; hollow ones are set aside or not confirmed. Colour is w: "
        "red below 0.2, amber below 0.4, grey below 0.6, light blue below 0.8, blue above. The ring is this run."
    )
    return section("Memory map", element("p", told, class_="muted"), _chart(drawn, newest))


def _chart(drawn: MemoryMap, newest: str) -> Html:
    import matplotlib as mpl  # noqa: PLC0415  (heavy imports are lazy)
    from matplotlib.figure import Figure  # noqa: PLC0415

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(10.4, 4.6))
        axes = figure.add_axes((0.02, 0.02, 0.96, 0.96))
        for row in range(max(0, len(drawn.names) - MOST), len(drawn.names)):
            colour = next(shade for bound, shade in SHADES if drawn.weights[row] < bound)
            mark = dict(MARKS).get(drawn.kinds[row], ".")
            face = colour if drawn.statuses[row] == "active" else "none"
            axes.plot(*drawn.points[row], mark, color=colour, markerfacecolor=face, markersize=6, alpha=0.85)
        if newest in drawn.names:
            axes.plot(*drawn.points[drawn.names.index(newest)], "o", color=BLUE, markerfacecolor="none", markersize=15)
        axes.set_xticks([])
        axes.set_yticks([])
        axes.margins(0.06)
        low, high = drawn.points.min(axis=0), drawn.points.max(axis=0)
        if np.all(high - low > 0):
            axes.set_aspect("equal", adjustable="datalim")
        out = StringIO()
        figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None})
    return themed(out.getvalue(), "every memory as a point, like ones near each other, coloured by weight")
