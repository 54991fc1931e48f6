"""From the name of an adapter to its folder: by id, by rank, by the name it was packaged under, by its place."""

from __future__ import annotations

from pathlib import Path

from dualbrain.adaptation.adapters.card import read_adapter_card
from dualbrain.adaptation.adapters.packaged import packaged_folder, packaged_names
from dualbrain.adaptation.adapters.registry import BARE, Adapters
from dualbrain.errors import InvalidSetup, UnknownName

PREFIX, CHAMPION, SHADOW, TORCH = "adapter:", "champion", "shadow:", "transformers:"


def is_adapter(name: str) -> bool:
    """Whether a planner's name means an adapter."""
    return name.startswith(PREFIX) or name in packaged_names()


def without_engine(name: str) -> str:
    """Who answers, whatever runs it: `name` without `transformers:`."""
    return name.removeprefix(TORCH)


def shadow_parts(name: str) -> tuple[str, str]:
    """`shadow:CANDIDATE@PLANNER` as the candidate's name and the planner's; without one, the champion serves."""
    candidate, _, serving = name.removeprefix(SHADOW).partition("@")
    return candidate if is_adapter(candidate) else PREFIX + candidate, serving or PREFIX + CHAMPION


def folder_of(name: str, adapters: Adapters, robot: str = "") -> Path:
    """Where the adapter that `name` means lies.

    `adapter:ID` (the beginning of an id), `adapter:champion` (of `robot`), `adapter:NAME` or NAME of a packaged one,
    `adapter:PATH` of a folder that a fit made. Raises `UnknownName`, `InvalidSetup`.
    """
    short = name.removeprefix(PREFIX)
    if short in packaged_names():
        return packaged_folder(short)
    if short == CHAMPION:
        return champion_at(adapters, champion_of(adapters, robot))
    if "/" in short:
        return Path(short)
    return adapters.at(id_of(short, adapters))


def id_of(name: str, adapters: Adapters, robot: str = "") -> str:
    """The id that `name` means: the beginning of one in the registry, or `champion` of `robot`; `adapter:` may lead it.

    Of a packaged adapter, or of one in a folder, it is that of its card. Raises `UnknownName`, `InvalidSetup`.
    """
    short = name.removeprefix(PREFIX)
    if short == CHAMPION:
        return champion_of(adapters, robot)
    if not in_registry(short):
        return read_adapter_card(folder_of(short, adapters)).id
    try:
        return adapters.find(short)
    except UnknownName as error:
        known = (*error.known, *packaged_names(), CHAMPION)
        raise UnknownName("adapter", short, known, owner="this installation") from error


def in_registry(name: str) -> bool:
    """Whether `name` can only mean an adapter of the registry: no packaged one, no folder."""
    short = name.removeprefix(PREFIX)
    return short not in packaged_names() and "/" not in short


def champion_at(adapters: Adapters, one: str) -> Path:
    """The folder of `one`, which serves; raises `InvalidSetup` with the way out if it is damaged."""
    if fault := adapters.fault(one):
        fix = "Let the former one serve: `dualbrain adapters rollback --reason WORDS`."
        raise InvalidSetup(f"champion {one[:16]}", got=fault, allowed="as it was added", fix=fix)
    return adapters.at(one)


def champion_of(adapters: Adapters, robot: str) -> str:
    """The adapter that serves for `robot`; raises `InvalidSetup` if none does."""
    return adapters.champion(place_of_champion(adapters, robot))


def place_of_champion(adapters: Adapters, robot: str) -> tuple[str, str]:
    """Where the champion of `robot` serves: of several bases, that on which one was promoted or rolled back to last.

    What was only added changes nothing. Raises `InvalidSetup` if no adapter serves.
    """
    places = [entry.place for entry in adapters.journal() if entry.place[0] == robot and entry.kind != "added"]
    for place in reversed(places):
        if adapters.champion(place) != BARE:
            return place
    fix = "Promote one: `dualbrain adapters measure`, then `dualbrain adapters promote`."
    raise InvalidSetup(f"champion of {robot or 'no robot'}", got="none", allowed="a promoted adapter", fix=fix)
