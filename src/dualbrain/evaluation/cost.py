"""Adaptation cost (paper 7.3, metric 8): what each adapter took, beside what it reached."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from dualbrain.adaptation.adapter_card import WEIGHTS, AdapterCard, read_adapter_card
from dualbrain.adaptation.adapters import Adapters
from dualbrain.adaptation.serving.names import folder_of, is_adapter, without_engine
from dualbrain.evaluation.grids import NONE, Grid, cell, measured
from dualbrain.evaluation.metrics import BY_NAME
from dualbrain.evaluation.row import Row
from dualbrain.evaluation.suite import Suite


class Cost(msgspec.Struct, frozen=True):
    """What one adapter took: `samples` proposed by anybody, optimiser `steps`, size of its weights [bytes]."""

    id: str
    base: str
    samples: int
    steps: int
    epochs: float
    size: int
    bootstrapped: bool


def costs(suite: Suite, adapters: Path, robot: str) -> dict[str, Cost]:
    """By part of the suite (`adapted`, …): what its adapter took; parts without an adapter are left out."""
    found: dict[str, Cost] = {}
    for part, planner in suite.planners.items():
        if is_adapter(name := without_engine(planner)):
            folder = folder_of(name, Adapters(adapters), robot)
            found[part] = _cost(read_adapter_card(folder), (folder / WEIGHTS).stat().st_size)
    return found


def _cost(card: AdapterCard, size: int) -> Cost:
    samples = sum(card.sources.values())
    epochs = card.steps * card.config.fit.batch / max(1, samples)
    return Cost(card.id[:16], card.base, samples, card.steps, epochs, size, card.bootstrapped)


def adapters_of(config: dict[str, Any]) -> dict[str, Cost]:
    """What the adapters of a run took, by part, as its configuration has it."""
    return msgspec.convert(config.get("adapters", {}), dict[str, Cost])


def cost_grid(rows: Sequence[Row], config: dict[str, Any]) -> Grid:
    """Each adapter with the compliance and the frequency of the methods that ask it."""
    found = adapters_of(config)
    arms: dict[str, dict[str, Any]] = config.get("methods", {})
    lines: list[tuple[str, ...]] = []
    for part, cost in found.items():
        for method in [name for name, arm in arms.items() if arm["asks"] == part]:
            reached = (
                cell(measured(rows, method, name), BY_NAME[name].unit)
                for name in ("one-shot compliance", "intervention frequency")
            )
            own = "others too" if cost.bootstrapped else "the base alone"
            figures = (str(cost.samples), str(cost.steps), f"{cost.epochs:g}", f"{cost.size / 1e6:.1f} MB", own)
            lines.append((part, cost.id or NONE, *figures, method, *reached))
    head = ("part", "adapter", "samples", "steps", "epochs", "size", "proposed by", "method", "one-shot compliance",
            "intervention frequency")  # fmt: skip
    return Grid("Adaptation cost", head, tuple(lines), "what the adapters took, and what was reached with them")
