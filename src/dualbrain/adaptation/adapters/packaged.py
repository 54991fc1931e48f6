"""Adapters that are part of the package: one folder per name, listed when asked for."""

from __future__ import annotations

from pathlib import Path

from dualbrain.adaptation.adapters.card import CARD_FILE

PACKAGED_FOLDER = Path(__file__).parents[1] / "packaged"


def packaged_names() -> tuple[str, ...]:
    """Names of the packaged adapters."""
    return tuple(sorted(path.parent.name for path in PACKAGED_FOLDER.glob(f"*/{CARD_FILE}")))


def packaged_folder(name: str) -> Path:
    """The folder of the packaged adapter called `name`."""
    return PACKAGED_FOLDER / name
