"""The plot of the sensitivity sweeps: the Δ of every contract on every seed, by family, at one speed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import median

from experiments.planning.contract_sensitivity import DELTA_FLOOR, FAILURE_SCORE, FAMILIES, ScoresBySeed

SPEED = 0.2
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#f0e442")


def plot_sensitivity(
    tables: dict[tuple[str, float], ScoresBySeed], path: Path, speed: float = SPEED, order: Sequence[str] = FAMILIES
) -> None:
    """Draw a panel per family, in `order`: contracts sorted by success and median Δ, failures in a band at the top."""
    import matplotlib as mpl  # noqa: PLC0415  (heavy)

    mpl.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415

    shown = [family for family in order if (family, speed) in tables]
    figure, panels = plt.subplots(1, len(shown), figsize=(4.6 * len(shown), 4.8), sharey=True, squeeze=False)
    for panel, family in zip(panels[0], shown, strict=True):
        _panel(panel, family, tables[family, speed])
    panels[0][0].set_ylabel("Δ of a success (floor 1e-4)")
    panels[0][-1].legend(title="seed", fontsize=7, title_fontsize=7, loc="upper left", bbox_to_anchor=(1.01, 1.0))
    figure.suptitle(f"Valid contracts for one instruction at {speed} m/s: each dot is an episode", fontsize=11)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _sort_key(values: list[float]) -> tuple[float, float]:
    """Contracts with few failures come first, then those with a small median Δ."""
    good = [value for value in values if value < FAILURE_SCORE]
    return 1.0 - len(good) / len(values), median(good) if good else FAILURE_SCORE


def _panel(panel, family: str, scores: ScoresBySeed) -> None:
    names = sorted({name for line in scores.values() for name in line})
    names.sort(key=lambda name: _sort_key([line[name] for line in scores.values() if name in line]))
    failure_height = 0.3
    for (seed, line), colour in zip(scores.items(), COLOURS * 9, strict=False):
        shift = 0.5 * (list(scores).index(seed) / max(1, len(scores) - 1) - 0.5)
        known = [(place + shift, line[name]) for place, name in enumerate(names) if name in line]
        good = [(x, y) for x, y in known if y < FAILURE_SCORE]
        bad = [x for x, y in known if y == FAILURE_SCORE]
        panel.plot(*zip(*good, strict=True), "o", ms=4, color=colour, label=str(seed)) if good else None
        panel.plot(bad, [failure_height * (1 + 0.25 * shift)] * len(bad), "x", ms=4, color=colour)
    panel.axhspan(0.15, 0.6, color="0.93", zorder=0)
    panel.text(0.01, 0.985, "failed", transform=panel.transAxes, fontsize=8, va="top", color="0.35")
    panel.set_yscale("log")
    panel.set_ylim(DELTA_FLOOR * 0.7, 0.6)
    panel.set_xticks(range(len(names)), names, rotation=90, fontsize=5.5)
    panel.set_title(family, fontsize=10)
    panel.grid(axis="y", alpha=0.3)
