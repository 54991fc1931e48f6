"""Adapters that come with dualbrain: folders beside this room, by name; looked for when one is asked for."""

from __future__ import annotations

from pathlib import Path

from dualbrain.adaptation.adapters.card import CARD_FILE

PACKAGED_FOLDER = Path(__file__).parents[1] / "packaged"


def packaged_names() -> tuple[str, ...]:
    """Names of the adapters that are here."""
    return tuple(sorted(path.parent.name for path in PACKAGED_FOLDER.glob(f"*/{CARD_FILE}")))


def packaged_folder(name: str) -> Path:
    """Where the packaged adapter called `name` is."""
    return PACKAGED_FOLDER / name
