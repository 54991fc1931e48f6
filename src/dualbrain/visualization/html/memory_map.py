"""Memory map: every memory as a point, similar memories near each other, coloured by weight w."""

from __future__ import annotations

from io import StringIO

import numpy as np

from dualbrain.memory.maintenance.projection import MemoryProjection
from dualbrain.visualization.html.page import Html, element, section
from dualbrain.visualization.html.plot_style import AMBER, BLUE, MATPLOTLIB_STYLE, MUTED, RED, SKY, apply_page_theme

WEIGHT_COLOURS = ((0.2, RED), (0.4, AMBER), (0.6, MUTED), (0.8, SKY), (1.01, BLUE))
"""Colour of weights below each bound."""
MAX_POINTS = 3000
"""At most this many memories, the newest, are drawn."""
OUTCOME_MARKERS = (("succeeded", "o"), ("failed", "X"))
"""Marker by outcome; other outcomes are small points."""


def memory_map_section(projection: MemoryProjection, newest: str) -> Html:
    """Section with the map, in which a ring marks the memory `newest`; a sentence if there are too few memories."""
    if len(projection.episode_ids) < 3:
        return section("Memory map", element("p", "Too few memories for a map.", class_="muted"))
    legend = (
        f"{_count_in_words(len(projection.episode_ids))}; similar memories are near each other. The two axes show "
        f"{projection.explained_variance:.0%} of the variance. Circles succeeded, crosses failed, points had other "
        "outcomes; hollow markers are excluded or not confirmed. The colour is w: red below 0.2, amber below 0.4, grey "
        "below 0.6, light blue below 0.8, blue above. The ring marks this run."
    )
    return section("Memory map", element("p", legend, class_="muted"), _chart(projection, newest))


def _count_in_words(count: int) -> str:
    """The number of memories, and that of the drawn ones if it is less."""
    return f"{count} memories" if count <= MAX_POINTS else f"the newest {MAX_POINTS} of {count} memories"


def _chart(drawn: MemoryProjection, newest: str) -> Html:
    import matplotlib as mpl  # noqa: PLC0415  (heavy imports are lazy)
    from matplotlib.figure import Figure  # noqa: PLC0415

    with mpl.rc_context(MATPLOTLIB_STYLE):
        figure = Figure(figsize=(10.4, 4.6))
        axes = figure.add_axes((0.02, 0.02, 0.96, 0.96))
        for row in range(max(0, len(drawn.episode_ids) - MAX_POINTS), len(drawn.episode_ids)):
            colour = next(shade for bound, shade in WEIGHT_COLOURS if drawn.weights[row] < bound)
            mark = dict(OUTCOME_MARKERS).get(drawn.kinds[row], ".")
            face = colour if drawn.statuses[row] == "active" else "none"
            axes.plot(*drawn.points[row], mark, color=colour, markerfacecolor=face, markersize=6, alpha=0.85)
        if newest in drawn.episode_ids:
            axes.plot(
                *drawn.points[drawn.episode_ids.index(newest)], "o", color=BLUE, markerfacecolor="none", markersize=15
            )
        axes.set_xticks([])
        axes.set_yticks([])
        axes.margins(0.06)
        low, high = drawn.points.min(axis=0), drawn.points.max(axis=0)
        if np.all(high - low > 0):
            axes.set_aspect("equal", adjustable="datalim")
        out = StringIO()
        figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None})
    return apply_page_theme(out.getvalue(), "memories as points, similar ones near each other, coloured by weight")
