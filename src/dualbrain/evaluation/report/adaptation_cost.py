"""Adaptation cost (paper 7.3, metric 8): what each adapter took, beside what it reached."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from dualbrain.adaptation.adapters.card import WEIGHTS, AdapterCard, read_adapter_card
from dualbrain.adaptation.adapters.naming import folder_of, is_adapter, without_engine
from dualbrain.adaptation.adapters.registry import Adapters
from dualbrain.evaluation.analysis.metrics import BY_NAME
from dualbrain.evaluation.protocol.suite import Suite
from dualbrain.evaluation.report.tables import NONE, Grid, cell, measured
from dualbrain.evaluation.results.episode_row import Row

ADAPTED = "adapted"
"""How the parts of a suite begin whose planners a night has taught; the cost of a base is nobody's here."""


class Cost(msgspec.Struct, frozen=True):
    """What one adapter took: `samples` by anybody (held-out ones too), optimiser `steps`, its weights' size [bytes].

    `shown` is how many samples these steps have shown it, one as often as it was shown; 0 where that is not recorded.
    """

    id: str
    base: str
    samples: int
    steps: int
    size: int
    bootstrapped: bool
    shown: int = 0


def costs(suite: Suite, adapters: Path, robot: str) -> dict[str, Cost]:
    """By part of the suite (`adapted`, …): what its adapter took; parts without an adapter are left out."""
    found: dict[str, Cost] = {}
    for part, planner in suite.planners.items():
        if is_adapter(name := without_engine(planner)):
            folder = folder_of(name, Adapters(adapters), robot)
            found[part] = _cost(read_adapter_card(folder), (folder / WEIGHTS).stat().st_size)
    return found


def _cost(card: AdapterCard, size: int) -> Cost:
    shown = card.steps * card.config.fit.batch
    return Cost(card.id[:16], card.base, sum(card.sources.values()), card.steps, size, card.bootstrapped, shown)


def adapters_of(config: dict[str, Any]) -> dict[str, Cost]:
    """What the adapters of a run took, by part, as its configuration has it."""
    return msgspec.convert(config.get("adapters", {}), dict[str, Cost])


def cost_grid(rows: Sequence[Row], config: dict[str, Any]) -> Grid:
    """Each adapter of an adapted part, with the compliance and the frequency of the methods that ask it."""
    found = adapters_of(config)
    arms: dict[str, dict[str, Any]] = config.get("methods", {})
    lines: list[tuple[str, ...]] = []
    for part, cost in found.items():
        if not part.startswith(ADAPTED):
            continue
        for method in [name for name, arm in arms.items() if arm["asks"] == part]:
            reached = (
                cell(measured(rows, method, name), BY_NAME[name].unit)
                for name in ("one-shot compliance", "intervention frequency")
            )
            own = "others too" if cost.bootstrapped else "the base alone"
            figures = (str(cost.samples), str(cost.steps), str(cost.shown or NONE), f"{cost.size / 1e6:.1f} MB", own)
            lines.append((part, cost.id or NONE, *figures, method, *reached))
    head = (
        "part", "adapter", "samples, held-out ones too", "steps", "samples shown", "size", "proposed by", "method",
        "one-shot compliance", "intervention frequency",
    )  # fmt: skip
    return Grid("Adaptation cost", head, tuple(lines), "what the adapters took, and what was reached with them")
