"""Barriers of the filter, one file each. Modules with a `BARRIER` are discovered automatically."""

from __future__ import annotations

import importlib
import pkgutil

from dualbrain.safety.barriers.barrier import Barrier, Trial

__all__ = ["BARRIERS", "Barrier", "Trial"]


def _found() -> dict[str, Barrier]:
    """Every `BARRIER` of this package by name, those that are given up last first."""
    names = [
        module.name for module in pkgutil.iter_modules(__path__) if module.name not in ("__main__", "barrier", "scenarios")
    ]
    found: list[Barrier] = [importlib.import_module(f"{__name__}.{name}").BARRIER for name in names]
    return {barrier.name: barrier for barrier in sorted(found, key=lambda one: (one.rank or 0, one.name))}


BARRIERS = _found()
