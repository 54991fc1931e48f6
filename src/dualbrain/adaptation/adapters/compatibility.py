"""Compatibility of an adapter with the present configuration: robot, skill vocabulary and prompt template."""

from __future__ import annotations

from collections.abc import Mapping

from dualbrain.adaptation.adapters.card import AdapterCard
from dualbrain.errors import ConfigurationError
from dualbrain.planner.prompt.short_prompt import short_template_hash

REFIT_HINT = "Train an adapter for the present configuration with `dualbrain adapt`."


def registry_hashes(card: AdapterCard) -> dict[str, str]:
    """Hash of the skill vocabulary of each robot that the adapter was trained for."""
    return {card.robot: card.registry} | card.also


def require_same_prompt(card: AdapterCard) -> None:
    """Raise `ConfigurationError` unless the adapter was trained with the present short prompt template."""
    if card.prompt != (present := short_template_hash()):
        problem = (
            f"Adapter {card.id[:16]} was trained with the prompt template {card.prompt}; the present one is {present}."
        )
        raise ConfigurationError.stating(problem, fix=REFIT_HINT)


def require_compatible(card: AdapterCard, robot: str, registry: str, narrowed: Mapping[str, str] = {}) -> None:
    """Raise `ConfigurationError` unless the adapter was trained for `robot` with the vocabulary of hash `registry`.

    The hash covers skills, units and bounds: an adapter answers in the vocabulary of its training data. A vocabulary
    that only narrows that one is accepted too, because the gate rejects everything outside it: `narrowed` maps the hash
    of a narrower vocabulary (of a site) to that of the wider one (of the robot).
    """
    trained = registry_hashes(card)
    if robot not in trained:
        robots = ", ".join(sorted(trained))
        problem = f"Adapter {card.id[:16]} was trained for {robots}, not for {robot}."
        raise ConfigurationError.stating(problem, fix=REFIT_HINT)
    if trained[robot] not in {registry, narrowed.get(registry)}:
        problem = (
            f"Adapter {card.id[:16]} was trained for the vocabulary {trained[robot]} of {robot}, not for {registry}."
        )
        raise ConfigurationError.stating(problem, fix=REFIT_HINT)
