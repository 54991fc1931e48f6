"""Comparison of two adapters: the entries of their cards, and the weight change of each layer.

The distance of two low-rank changes is computed without a matrix larger than rank × rank:

    ‖B₁A₁ − B₂A₂‖² = tr(B₁ᵀB₁ A₁A₁ᵀ) − 2 tr(B₁ᵀB₂ A₂A₁ᵀ) + tr(B₂ᵀB₂ A₂A₂ᵀ)
"""

from __future__ import annotations

import math
from typing import Any

import msgspec

from dualbrain.adaptation.adapters.card import AdapterCard
from dualbrain.adaptation.conversion.peft_lora import LoraPair


class LayerDifference(msgspec.Struct, frozen=True):
    """Frobenius norms ‖BA‖ of one layer's weight change by each adapter (0 if unchanged), and of their difference."""

    layer: str
    first: float
    second: float
    apart: float


def compare_cards(first: AdapterCard, second: AdapterCard) -> dict[str, tuple[Any, Any]]:
    """The entries of the two cards that differ: (first, second) by dotted name."""
    first_entries, second_entries = _flatten(msgspec.to_builtins(first)), _flatten(msgspec.to_builtins(second))
    names = sorted(first_entries.keys() | second_entries.keys())
    return {
        name: (first_entries.get(name), second_entries.get(name))
        for name in names
        if first_entries.get(name) != second_entries.get(name)
    }


def compare_layers(first: dict[str, LoraPair], second: dict[str, LoraPair]) -> tuple[LayerDifference, ...]:
    """The difference of each layer that either adapter changes, the largest difference first."""
    found: list[LayerDifference] = []
    for layer in sorted(first.keys() | second.keys()):
        first_pair, second_pair = first.get(layer), second.get(layer)
        one, other = (0.0 if pair is None else _inner_product(pair, pair) for pair in (first_pair, second_pair))
        cross = _inner_product(first_pair, second_pair) if first_pair is not None and second_pair is not None else 0.0
        squared = max(one - 2.0 * cross + other, 0.0)
        found.append(LayerDifference(layer, math.sqrt(one), math.sqrt(other), math.sqrt(squared)))
    return tuple(sorted(found, key=lambda gap: -gap.apart))


def combine_layers(differences: tuple[LayerDifference, ...]) -> LayerDifference:
    """The norms over all layers together."""
    sizes = [math.sqrt(sum(getattr(gap, name) ** 2 for gap in differences)) for name in ("first", "second", "apart")]
    return LayerDifference("all", *sizes)


def _inner_product(one: LoraPair, other: LoraPair) -> float:
    """tr((B₁A₁)ᵀ B₂A₂)."""
    return float(((one.b.T @ other.b) * (one.a @ other.a.T)).sum())


def _flatten(entries: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in entries.items():
        if isinstance(value, dict):
            flat |= _flatten(value, f"{prefix}{name}.")
        else:
            flat[f"{prefix}{name}"] = value
    return flat
