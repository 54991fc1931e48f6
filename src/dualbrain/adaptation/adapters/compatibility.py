"""Whether an adapter may serve here: its robot, vocabulary and prompt must be those it was taught."""

from __future__ import annotations

from collections.abc import Mapping

from dualbrain.adaptation.adapters.card import AdapterCard
from dualbrain.errors import InvalidSetup
from dualbrain.planner.prompt.short_prompt import short_template_hash

FIX = "Fit an adapter for what is here: `dualbrain adapt`."


def vocabularies(card: AdapterCard) -> dict[str, str]:
    """Hash of the vocabulary by robot, for every robot that the adapter was taught."""
    return {card.robot: card.registry} | card.also


def require_prompt(card: AdapterCard) -> None:
    """Raise `InvalidSetup` if the adapter was taught on another prompt than we ask with."""
    if card.prompt != (ours := short_template_hash()):
        raise InvalidSetup(f"prompt of adapter {card.id[:16]}", got=card.prompt, allowed=ours, fix=FIX)


def require_fit(card: AdapterCard, robot: str, registry: str, narrowed: Mapping[str, str] = {}) -> None:
    """Raise `InvalidSetup` if the adapter was not taught `robot` with the vocabulary of hash `registry`.

    The hash holds skills, units and bounds: an adapter writes what it was taught, so another vocabulary refuses it. One
    that only narrows what it was taught does not, for the gate refuses what is outside: `narrowed` has, by the hash of
    a narrower vocabulary (that of a site), the hash of the wider one (the robot's own).
    """
    taught = vocabularies(card)
    if robot not in taught:
        allowed = ", ".join(sorted(taught))
        raise InvalidSetup(f"robot of adapter {card.id[:16]}", got=robot, allowed=allowed, fix=FIX)
    if taught[robot] not in {registry, narrowed.get(registry)}:
        got = f"{registry} of {robot}"
        raise InvalidSetup(f"vocabulary of adapter {card.id[:16]}", got=got, allowed=taught[robot], fix=FIX)
