"""The style of every plot: colours, fonts and lines, for charts of a page (SVG) and for image files (PNG).

Charts of a page take their colours from its style sheet, so they follow its light and dark scheme. Image files use the
light colours of the same style sheet, in letters that remain legible at the width of a README column.
"""

from __future__ import annotations

import re
from collections.abc import Generator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from dualbrain.visualization.html.page import Html, palette_css

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.figure import Figure

# Each colour is drawn as a placeholder that no plot uses otherwise; `apply_page_theme` replaces it by a CSS variable.
PLACEHOLDER_COLOURS = {
    name: f"#0101{k + 1:02x}"
    for k, name in enumerate(
        ("text", "muted", "line", "faint", "blue", "sky", "orange", "amber", "red", "rose", "green", "card", "violet")
    )
}
TEXT, MUTED, LINE, FAINT, BLUE, SKY, ORANGE, AMBER, RED, ROSE, GREEN, CARD, VIOLET = PLACEHOLDER_COLOURS.values()

LINE_COLOURS = (BLUE, ORANGE, GREEN, RED, VIOLET, TEXT, SKY, MUTED)
"""Colours of lines and bars in their order."""
MATPLOTLIB_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "dualbrain",
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "text.parse_math": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": LINE,
    "axes.labelcolor": MUTED,
    "text.color": TEXT,
    "xtick.color": LINE,
    "ytick.color": LINE,
    "xtick.labelcolor": MUTED,
    "ytick.labelcolor": MUTED,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "axes.linewidth": 0.8,
    "grid.color": FAINT,
    "grid.linewidth": 0.8,
    "lines.solid_joinstyle": "round",
    "hatch.linewidth": 0.6,
}
IMAGE_FONT_SIZE, IMAGE_DPI = 12, 150
"""Size of letters [points] and resolution [1/inch] of image files, whose width is at most `IMAGE_WIDTH`."""
IMAGE_WIDTH = 9.0
"""Width of an image file [inch]."""


def light_colours() -> dict[str, str]:
    """The colours of the light scheme of the page by name, as hexadecimal numbers."""
    light = palette_css().partition("@media")[0]
    return dict(re.findall(r"--([a-z]+): (#[0-9a-f]{6})", light))


@contextmanager
def image_figure(path: Path, height: float) -> Generator[Figure]:
    """A figure of `height` [inch] in this style, saved as an image file when the body ends.

    Inside the body the colour constants of this module are not valid: use `light_colours`.
    """
    import matplotlib as mpl  # noqa: PLC0415  (heavy imports are lazy)
    from cycler import cycler  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    colours = light_colours()
    placeholders = {placeholder: colours[name] for name, placeholder in PLACEHOLDER_COLOURS.items()}
    style = {
        key: placeholders.get(value, value) if isinstance(value, str) else value
        for key, value in MATPLOTLIB_STYLE.items()
    }
    style |= {
        "font.size": IMAGE_FONT_SIZE,
        "text.parse_math": True,  # powers of ten on logarithmic axes
        "figure.facecolor": colours["card"],
        "axes.prop_cycle": cycler(color=[placeholders[one] for one in LINE_COLOURS]),
        "axes.grid": True,
        "axes.axisbelow": True,
        "axes.titleweight": "bold",
        "axes.titlelocation": "left",
        "legend.frameon": False,
    }
    with mpl.rc_context(style):
        figure = Figure(figsize=(IMAGE_WIDTH, height), layout="constrained")
        yield figure
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=IMAGE_DPI, metadata={"Software": None})


def apply_page_theme(svg: str, label: str) -> Html:
    """The SVG element without XML prologue, with the colours and fonts of the page; `label` describes it to readers."""
    svg = svg[svg.index("<svg") :]
    for name, placeholder in PLACEHOLDER_COLOURS.items():
        svg = svg.replace(placeholder, f"var(--{name})")
    svg = re.sub(
        r"font: (?:bold |[0-9]+ )?([0-9.]+)px [^;\"]*",
        lambda m: m[0].split("px")[0] + "px system-ui, 'DejaVu Sans', sans-serif",
        svg,
    )
    before, _, rest = svg.partition("<metadata>")
    svg = before + rest.partition("</metadata>")[2] if rest else svg
    return Html(svg.replace("<svg ", f'<svg role="img" aria-label="{label}" ', 1))
