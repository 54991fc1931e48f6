"""Whether an adapter may serve here: its robot, vocabulary and prompt must be those it was taught."""

from __future__ import annotations

from collections.abc import Mapping

from dualbrain.adaptation.adapters.card import AdapterCard
from dualbrain.errors import ConfigurationError
from dualbrain.planner.prompt.short_prompt import short_template_hash

REFIT_HINT = "Fit an adapter for what is here: `dualbrain adapt`."


def registry_hashes(card: AdapterCard) -> dict[str, str]:
    """Hash of the vocabulary by robot, for every robot that the adapter was taught."""
    return {card.robot: card.registry} | card.also


def require_same_prompt(card: AdapterCard) -> None:
    """Raise `InvalidSetup` if the adapter was taught on another prompt than we ask with."""
    if card.prompt != (ours := short_template_hash()):
        raise ConfigurationError(f"prompt of adapter {card.id[:16]}", got=card.prompt, allowed=ours, fix=REFIT_HINT)


def require_compatible(card: AdapterCard, robot: str, registry: str, narrowed: Mapping[str, str] = {}) -> None:
    """Raise `InvalidSetup` if the adapter was not taught `robot` with the vocabulary of hash `registry`.

    The hash holds skills, units and bounds: an adapter writes what it was taught, so another vocabulary refuses it. One
    that only narrows what it was taught does not, for the gate refuses what is outside: `narrowed` has, by the hash of
    a narrower vocabulary (that of a site), the hash of the wider one (the robot's own).
    """
    taught = registry_hashes(card)
    if robot not in taught:
        allowed = ", ".join(sorted(taught))
        raise ConfigurationError(f"robot of adapter {card.id[:16]}", got=robot, allowed=allowed, fix=REFIT_HINT)
    if taught[robot] not in {registry, narrowed.get(registry)}:
        got = f"{registry} of {robot}"
        raise ConfigurationError(
            f"vocabulary of adapter {card.id[:16]}", got=got, allowed=taught[robot], fix=REFIT_HINT
        )
