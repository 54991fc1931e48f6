"""Names of adapters: by id, by rank (`champion`), by packaged name, by folder."""

from __future__ import annotations

from pathlib import Path

from dualbrain.adaptation.adapters.card import read_adapter_card
from dualbrain.adaptation.adapters.packaged import packaged_folder, packaged_names
from dualbrain.adaptation.adapters.registry import NO_ADAPTER, AdapterRegistry
from dualbrain.errors import ConfigurationError, UnknownNameError

ADAPTER_PREFIX, CHAMPION, SHADOW_PREFIX, TORCH_PREFIX = "adapter:", "champion", "shadow:", "transformers:"


def is_adapter(name: str) -> bool:
    """Whether a planner's name denotes an adapter."""
    return name.startswith(ADAPTER_PREFIX) or name in packaged_names()


def strip_torch_prefix(name: str) -> str:
    """`name` without the prefix `transformers:`, which selects the runtime only."""
    return name.removeprefix(TORCH_PREFIX)


def parse_shadow_name(name: str) -> tuple[str, str]:
    """Candidate and serving planner of `shadow:CANDIDATE@PLANNER`; without PLANNER the champion serves."""
    candidate, _, serving = name.removeprefix(SHADOW_PREFIX).partition("@")
    return candidate if is_adapter(candidate) else ADAPTER_PREFIX + candidate, serving or ADAPTER_PREFIX + CHAMPION


def resolve_folder(name: str, adapters: AdapterRegistry, robot: str = "") -> Path:
    """The folder of the adapter called `name`.

    `adapter:ID` (the beginning of an id), `adapter:champion` (of `robot`), `adapter:NAME` or NAME of a packaged
    adapter, or `adapter:PATH` of a folder that training wrote. Raises `UnknownNameError`, `ConfigurationError`.
    """
    short = name.removeprefix(ADAPTER_PREFIX)
    if short in packaged_names():
        return packaged_folder(short)
    if short == CHAMPION:
        return champion_folder(adapters, champion_id(adapters, robot))
    if "/" in short:
        return Path(short)
    return adapters.adapter_folder(resolve_id(short, adapters))


def resolve_id(name: str, adapters: AdapterRegistry, robot: str = "") -> str:
    """The id of the adapter called `name`: the beginning of an id, or `champion` of `robot`.

    The prefix `adapter:` is optional. For a packaged adapter or a folder it is the id of its card. Raises
    `UnknownNameError`, `ConfigurationError`.
    """
    short = name.removeprefix(ADAPTER_PREFIX)
    if short == CHAMPION:
        return champion_id(adapters, robot)
    if not is_registry_name(short):
        return read_adapter_card(resolve_folder(short, adapters)).id
    try:
        return adapters.find(short)
    except UnknownNameError as error:
        known = (*error.known, *packaged_names(), CHAMPION)
        raise UnknownNameError("adapter", short, known, owner="this installation") from error


def is_registry_name(name: str) -> bool:
    """Whether `name` can only denote an adapter of the registry, not a packaged one or a folder."""
    short = name.removeprefix(ADAPTER_PREFIX)
    return short not in packaged_names() and "/" not in short


def champion_folder(adapters: AdapterRegistry, adapter_id: str) -> Path:
    """The folder of a champion; raises `ConfigurationError` with the remedy if it is damaged."""
    if fault := adapters.find_fault(adapter_id):
        fix = "Return to the former champion with `dualbrain adapters rollback --reason WORDS`."
        raise ConfigurationError.stating(f"The champion {adapter_id[:16]} is damaged. {fault}", fix=fix)
    return adapters.adapter_folder(adapter_id)


def champion_id(adapters: AdapterRegistry, robot: str) -> str:
    """The id of the champion of `robot`; raises `ConfigurationError` if there is none."""
    return adapters.champion(champion_place(adapters, robot))


def champion_place(adapters: AdapterRegistry, robot: str) -> tuple[str, str]:
    """The place (robot, base hash) of the champion of `robot`.

    If the robot has adapters on several bases, it is the place of the latest promotion or rollback; adding an adapter
    changes nothing. Raises `ConfigurationError` if no adapter serves.
    """
    places = [entry.place for entry in adapters.entries() if entry.place[0] == robot and entry.kind != "added"]
    for place in reversed(places):
        if adapters.champion(place) != NO_ADAPTER:
            return place
    fix = "Promote one with `dualbrain adapters measure` and `dualbrain adapters promote`."
    problem = f"There is no champion of {robot}." if robot else "A champion serves one robot, and no robot is named."
    raise ConfigurationError.stating(problem, fix=fix)
