"""From the name of an adapter to its folder: by id, by rank, by the name it was packaged under, by its place."""

from __future__ import annotations

from pathlib import Path

from dualbrain.adaptation.adapters import BARE, Adapters
from dualbrain.adaptation.serving.packaged import packaged_folder, packaged_names
from dualbrain.errors import InvalidSetup

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
        return adapters.at(champion_of(adapters, robot))
    if "/" in short:
        return Path(short)
    return adapters.at(short)


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
