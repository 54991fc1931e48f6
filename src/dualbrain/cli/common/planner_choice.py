"""The planner that a command asks if none is named."""

from __future__ import annotations

from pathlib import Path

from dualbrain.planner.registry import DEFAULT_PLANNER, PACKAGED_PLANNER


def choose_planner(name: str, robot: str, cache: Path) -> tuple[str, str]:
    """The planner to open and a notice for the user, "" if there is none.

    A given `name` is used. Otherwise it is `DEFAULT_PLANNER` if its weights are in `cache`, else the first packaged
    planner that was trained for `robot` and whose base model is there, else `DEFAULT_PLANNER`, whose error names the
    download.
    """
    if name or is_downloaded(DEFAULT_PLANNER, cache):
        return name or DEFAULT_PLANNER, ""
    packaged = next((one for one in _packaged_planners() if _can_serve(one, robot, cache)), "")
    if not packaged:
        return DEFAULT_PLANNER, ""
    return packaged, (
        f"Planner: {packaged}, because {DEFAULT_PLANNER} (1.1 GB) is not downloaded. "
        f"Download it with `dualbrain models fetch {DEFAULT_PLANNER}`."
    )


def is_downloaded(name: str, cache: Path) -> bool:
    """Whether the model file called `name` is in `cache` (its size is compared, its content is not read)."""
    from dualbrain.core.weights import list_weights

    return any(status.present for status in list_weights(cache) if status.file.name == name)


def base_model(name: str) -> str:
    """The model file that the packaged adapter called `name` needs; any other name is returned unchanged."""
    from dualbrain.adaptation.adapters.card import read_adapter_card
    from dualbrain.adaptation.adapters.packaged import packaged_folder, packaged_names

    while name in packaged_names():
        name = read_adapter_card(packaged_folder(name)).base
    return name


def _packaged_planners() -> tuple[str, ...]:
    from dualbrain.adaptation.adapters.packaged import packaged_names

    return (PACKAGED_PLANNER, *(name for name in packaged_names() if name != PACKAGED_PLANNER))


def _can_serve(name: str, robot: str, cache: Path) -> bool:
    """Whether the packaged adapter called `name` was trained for `robot`, and its base model is in `cache`."""
    from dualbrain.adaptation.adapters.card import read_adapter_card
    from dualbrain.adaptation.adapters.packaged import packaged_folder

    card = read_adapter_card(packaged_folder(name))
    return robot in (card.robot, *card.also) and is_downloaded(base_model(name), cache)
