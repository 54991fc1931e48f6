"""How two adapters differ: in what they were made of, and layer by layer in what they compute.

‖B₁A₁ − B₂A₂‖² = tr(B₁ᵀB₁ A₁A₁ᵀ) − 2 tr(B₁ᵀB₂ A₂A₁ᵀ) + tr(B₂ᵀB₂ A₂A₂ᵀ): no matrix larger than rank × rank is made.
"""

from __future__ import annotations

import math
from typing import Any

import msgspec

from dualbrain.adaptation.adapters.card import AdapterCard
from dualbrain.adaptation.conversion.peft_lora import LoraPair


class LayerDifference(msgspec.Struct, frozen=True):
    """Sizes ‖BA‖ of one layer's change by both adapters, 0 where one leaves it alone, and of their difference."""

    layer: str
    first: float
    second: float
    apart: float


def compare_cards(first: AdapterCard, second: AdapterCard) -> dict[str, tuple[Any, Any]]:
    """The entries of the cards that differ, dials by their dotted names."""
    ours, theirs = _flatten(msgspec.to_builtins(first)), _flatten(msgspec.to_builtins(second))
    names = sorted(ours.keys() | theirs.keys())
    return {name: (ours.get(name), theirs.get(name)) for name in names if ours.get(name) != theirs.get(name)}


def compare_layers(first: dict[str, LoraPair], second: dict[str, LoraPair]) -> tuple[LayerDifference, ...]:
    """Layer by layer, the widest apart first."""
    found: list[LayerDifference] = []
    for layer in sorted(first.keys() | second.keys()):
        ours, theirs = first.get(layer), second.get(layer)
        one, other = (0.0 if pair is None else _inner_product(pair, pair) for pair in (ours, theirs))
        cross = _inner_product(ours, theirs) if ours is not None and theirs is not None else 0.0
        squared = max(one - 2.0 * cross + other, 0.0)
        found.append(LayerDifference(layer, math.sqrt(one), math.sqrt(other), math.sqrt(squared)))
    return tuple(sorted(found, key=lambda gap: -gap.apart))


def combine_layers(found: tuple[LayerDifference, ...]) -> LayerDifference:
    """All layers together."""
    sizes = [math.sqrt(sum(getattr(gap, name) ** 2 for gap in found)) for name in ("first", "second", "apart")]
    return LayerDifference("all", *sizes)


def _inner_product(one: LoraPair, other: LoraPair) -> float:
    """tr((B₁A₁)ᵀ B₂A₂)."""
    return float(((one.b.T @ other.b) * (one.a @ other.a.T)).sum())


def _flatten(told: dict[str, Any], before: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in told.items():
        if isinstance(value, dict):
            flat |= _flatten(value, f"{before}{name}.")
        else:
            flat[f"{before}{name}"] = value
    return flat
