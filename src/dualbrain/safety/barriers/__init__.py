"""Barriers of the safety filter, one module each. A module that defines `BARRIER` is discovered automatically."""

from __future__ import annotations

import importlib
import pkgutil

from dualbrain.safety.barriers.barrier import BarrierSpec, Scenario

__all__ = ["BARRIERS", "BarrierSpec", "Scenario"]


def _discover() -> dict[str, BarrierSpec]:
    """Every `BARRIER` of this package by name, in the order of `Rank` (the rows that are relaxed last come first)."""
    names = [
        module.name
        for module in pkgutil.iter_modules(__path__)
        if module.name not in ("__main__", "barrier", "scenarios")
    ]
    found: list[BarrierSpec] = [importlib.import_module(f"{__name__}.{name}").BARRIER for name in names]
    return {barrier.name: barrier for barrier in sorted(found, key=lambda spec: (spec.rank or 0, spec.name))}


BARRIERS = _discover()
