"""Adaptation cost (paper 7.3, metric 8): samples, steps and size of each adapter, beside its compliance."""

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
"""Prefix of the planner roles of a suite that use a trained adapter; base models have no adaptation cost."""


class AdapterCost(msgspec.Struct, frozen=True, kw_only=True):
    """Cost of one adapter: `samples` of every source (including held-out ones), optimiser `steps`, `size` [bytes].

    `shown` counts the samples in all batches, with repetitions; 0 if it was not recorded. `bootstrapped` is true if
    another planner than the base proposed some of the samples.
    """

    id: str
    base: str
    samples: int
    steps: int
    size: int
    bootstrapped: bool
    shown: int = 0


def adapter_costs(suite: Suite, adapters: Path, robot: str) -> dict[str, AdapterCost]:
    """Cost of the adapter of each planner role of the suite (`adapted`, …); roles without an adapter are left out."""
    found: dict[str, AdapterCost] = {}
    for role, planner in suite.planners.items():
        if is_adapter(name := strip_torch_prefix(planner)):
            folder = resolve_folder(name, AdapterRegistry(adapters), robot)
            found[role] = _cost(read_adapter_card(folder), (folder / WEIGHTS_FILE).stat().st_size)
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
    """Cost of the adapters of a run by planner role, from its configuration."""
    return msgspec.convert(config.get("adapters", {}), dict[str, AdapterCost])


def cost_table(rows: Sequence[EpisodeRow], config: dict[str, Any]) -> Table:
    """Each adapter, with the compliance and the intervention frequency of the methods that use it."""
    found = costs_from_config(config)
    arms: dict[str, dict[str, Any]] = config.get("methods", {})
    lines: list[tuple[str, ...]] = []
    for role, cost in found.items():
        if not role.startswith(ADAPTED_ROLE_PREFIX):
            continue
        for method in [name for name, arm in arms.items() if arm["asks"] == role]:
            reached = (
                format_estimate(estimate_metric(rows, method, name), METRIC_BY_NAME[name].unit)
                for name in ("one-shot compliance", "intervention frequency")
            )
            source = "base and other planners" if cost.bootstrapped else "base only"
            figures = (str(cost.samples), str(cost.steps), str(cost.shown or DASH), f"{cost.size / 1e6:.1f} MB", source)
            lines.append((role, cost.id or DASH, *figures, method, *reached))
    header = (
        "planner role",
        "adapter",
        "samples, with held-out ones",
        "steps",
        "samples shown",
        "size",
        "proposed by",
        "method",
        "one-shot compliance",
        "intervention frequency",
    )
    return Table(
        "Adaptation cost", header, tuple(lines), "cost of each adapter, and the results of the methods with it"
    )
