"""From the name of an adapter to its folder: by id, by rank, by the name it was packaged under, by its place."""

from __future__ import annotations

from pathlib import Path

from dualbrain.adaptation.adapters.card import read_adapter_card
from dualbrain.adaptation.adapters.packaged import packaged_folder, packaged_names
from dualbrain.adaptation.adapters.registry import NO_ADAPTER, AdapterRegistry
from dualbrain.errors import ConfigurationError, UnknownNameError

ADAPTER_PREFIX, CHAMPION, SHADOW_PREFIX, TORCH_PREFIX = "adapter:", "champion", "shadow:", "transformers:"


def is_adapter(name: str) -> bool:
    """Whether a planner's name means an adapter."""
    return name.startswith(ADAPTER_PREFIX) or name in packaged_names()


def strip_torch_prefix(name: str) -> str:
    """Who answers, whatever runs it: `name` without `transformers:`."""
    return name.removeprefix(TORCH_PREFIX)


def parse_shadow_name(name: str) -> tuple[str, str]:
    """`shadow:CANDIDATE@PLANNER` as the candidate's name and the planner's; without one, the champion serves."""
    candidate, _, serving = name.removeprefix(SHADOW_PREFIX).partition("@")
    return candidate if is_adapter(candidate) else ADAPTER_PREFIX + candidate, serving or ADAPTER_PREFIX + CHAMPION


def resolve_folder(name: str, adapters: AdapterRegistry, robot: str = "") -> Path:
    """Where the adapter that `name` means lies.

    `adapter:ID` (the beginning of an id), `adapter:champion` (of `robot`), `adapter:NAME` or NAME of a packaged one,
    `adapter:PATH` of a folder that a fit made. Raises `UnknownName`, `InvalidSetup`.
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
    """The id that `name` means: the beginning of one in the registry, or `champion` of `robot`; `adapter:` may lead it.

    Of a packaged adapter, or of one in a folder, it is that of its card. Raises `UnknownName`, `InvalidSetup`.
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
    """Whether `name` can only mean an adapter of the registry: no packaged one, no folder."""
    short = name.removeprefix(ADAPTER_PREFIX)
    return short not in packaged_names() and "/" not in short


def champion_folder(adapters: AdapterRegistry, one: str) -> Path:
    """The folder of `one`, which serves; raises `InvalidSetup` with the way out if it is damaged."""
    if fault := adapters.find_fault(one):
        fix = "Let the former one serve: `dualbrain adapters rollback --reason WORDS`."
        raise ConfigurationError(f"champion {one[:16]}", got=fault, allowed="as it was added", fix=fix)
    return adapters.adapter_folder(one)


def champion_id(adapters: AdapterRegistry, robot: str) -> str:
    """The adapter that serves for `robot`; raises `InvalidSetup` if none does."""
    return adapters.champion(champion_place(adapters, robot))


def champion_place(adapters: AdapterRegistry, robot: str) -> tuple[str, str]:
    """Where the champion of `robot` serves: of several bases, that on which one was promoted or rolled back to last.

    What was only added changes nothing. Raises `InvalidSetup` if no adapter serves.
    """
    places = [entry.place for entry in adapters.entries() if entry.place[0] == robot and entry.kind != "added"]
    for place in reversed(places):
        if adapters.champion(place) != NO_ADAPTER:
            return place
    fix = "Promote one: `dualbrain adapters measure`, then `dualbrain adapters promote`."
    raise ConfigurationError(f"champion of {robot or 'no robot'}", got="none", allowed="a promoted adapter", fix=fix)
