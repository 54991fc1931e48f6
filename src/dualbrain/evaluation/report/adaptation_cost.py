"""Adaptation cost (paper 7.3, metric 8): what each adapter took, beside what it reached."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from dualbrain.adaptation.adapters.card import WEIGHTS_FILE, AdapterCard, read_adapter_card
from dualbrain.adaptation.adapters.naming import is_adapter, resolve_folder, strip_torch_prefix
from dualbrain.adaptation.adapters.registry import AdapterRegistry
from dualbrain.evaluation.analysis.metrics import METRIC_BY_NAME
from dualbrain.evaluation.protocol.suite import Suite
from dualbrain.evaluation.report.tables import DASH, Table, estimate_metric, format_estimate
from dualbrain.evaluation.results.episode_row import EpisodeRow

ADAPTED_ROLE_PREFIX = "adapted"
"""How the parts of a suite begin whose planners a night has taught; the cost of a base is nobody's here."""


class AdapterCost(msgspec.Struct, frozen=True, kw_only=True):
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


def adapter_costs(suite: Suite, adapters: Path, robot: str) -> dict[str, AdapterCost]:
    """By part of the suite (`adapted`, …): what its adapter took; parts without an adapter are left out."""
    found: dict[str, AdapterCost] = {}
    for part, planner in suite.planners.items():
        if is_adapter(name := strip_torch_prefix(planner)):
            folder = resolve_folder(name, AdapterRegistry(adapters), robot)
            found[part] = _cost(read_adapter_card(folder), (folder / WEIGHTS_FILE).stat().st_size)
    return found


def _cost(card: AdapterCard, size: int) -> AdapterCost:
    shown = card.steps * card.config.fit.batch
    return AdapterCost(
        id=card.id[:16],
        base=card.base,
        samples=sum(card.sources.values()),
        steps=card.steps,
        size=size,
        bootstrapped=card.bootstrapped,
        shown=shown,
    )


def costs_from_config(config: dict[str, Any]) -> dict[str, AdapterCost]:
    """What the adapters of a run took, by part, as its configuration has it."""
    return msgspec.convert(config.get("adapters", {}), dict[str, AdapterCost])


def cost_table(rows: Sequence[EpisodeRow], config: dict[str, Any]) -> Table:
    """Each adapter of an adapted part, with the compliance and the frequency of the methods that ask it."""
    found = costs_from_config(config)
    arms: dict[str, dict[str, Any]] = config.get("methods", {})
    lines: list[tuple[str, ...]] = []
    for part, cost in found.items():
        if not part.startswith(ADAPTED_ROLE_PREFIX):
            continue
        for method in [name for name, arm in arms.items() if arm["asks"] == part]:
            reached = (
                format_estimate(estimate_metric(rows, method, name), METRIC_BY_NAME[name].unit)
                for name in ("one-shot compliance", "intervention frequency")
            )
            own = "others too" if cost.bootstrapped else "the base alone"
            figures = (str(cost.samples), str(cost.steps), str(cost.shown or DASH), f"{cost.size / 1e6:.1f} MB", own)
            lines.append((part, cost.id or DASH, *figures, method, *reached))
    head = (
        "part",
        "adapter",
        "samples, held-out ones too",
        "steps",
        "samples shown",
        "size",
        "proposed by",
        "method",
        "one-shot compliance",
        "intervention frequency",
    )
    return Table("Adaptation cost", head, tuple(lines), "what the adapters took, and what was reached with them")
