"""The stack of an adapter: the unchanged GGUF file, the packaged adapter it was trained on, if any, and itself."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dualbrain.adaptation.adapters.card import AdapterCard, read_adapter_card
from dualbrain.adaptation.adapters.packaged import packaged_folder, packaged_names
from dualbrain.adaptation.conversion.peft_lora import read_lora
from dualbrain.core.weights import find_weight_file, locate_weights
from dualbrain.errors import ConfigurationError


@dataclass(frozen=True, slots=True)
class AdapterLayer:
    """One adapter with its folder and its verified card."""

    folder: Path
    card: AdapterCard


@dataclass(frozen=True, slots=True)
class AdapterStack:
    """A base and the adapters on it, the lowest first; all are applied at once, each at full strength.

    W x + B₁A₁x + B₂A₂x: an adapter that was trained on a base with another adapter needs that adapter when it serves.
    """

    base: str
    gguf: Path
    layers: tuple[AdapterLayer, ...]

    @property
    def top_card(self) -> AdapterCard:
        """The card of the adapter that is served."""
        return self.layers[-1].card

    @property
    def without_top(self) -> AdapterStack:
        """The base that the served adapter was trained on."""
        return AdapterStack(self.base, self.gguf, self.layers[:-1])


def adapter_author(card: AdapterCard) -> str:
    """The author recorded for proposals of an adapter: base and adapter."""
    return f"{card.base}+{card.id[:16]}"


def load_stack(folder: Path, cache: Path) -> AdapterStack:
    """The adapter in `folder` and all below it, each verified to be plain LoRA with the weights that its card names.

    Every runtime uses this check, so an adapter that one runtime rejects is served by none. Raises as `read_layers` and
    `read_lora` do, and `MissingDependencyError` or `ChecksumError` for the base.
    """
    layers = read_layers(folder)
    for layer in layers:
        read_lora(layer.folder)
    lowest = layers[0].card.base
    return AdapterStack(lowest, locate_weights(lowest, cache), layers)


def read_layers(folder: Path) -> tuple[AdapterLayer, ...]:
    """The adapter in `folder` and those below it, the lowest first; the model file of the base is not needed.

    Raises `ConfigurationError` for changed weights or a base of another hash, `UnknownNameError` for an unknown base.
    """
    layers = [AdapterLayer(folder, read_adapter_card(folder))]
    while layers[0].card.base in packaged_names():
        beneath = packaged_folder(layers[0].card.base)
        layers.insert(0, AdapterLayer(beneath, read_adapter_card(beneath)))
        _require_base_hash(layers[1].card, layers[0].card.id)
        if len(layers) > len(packaged_names()) + 1:
            raise ConfigurationError.stating(
                f"The packaged adapters below {folder.name} form a cycle of bases.", fix="Reinstall dualbrain."
            )
    lowest = layers[0].card
    _require_base_hash(lowest, find_weight_file(lowest.base).sha256)
    return tuple(layers)


def _require_base_hash(card: AdapterCard, found: str) -> None:
    if card.base_sha256 != found:
        problem = (
            f"Adapter {card.id[:16]} was trained on another {card.base}, with the SHA-256 {card.base_sha256}; "
            f"that of the present one is {found}."
        )
        raise ConfigurationError.stating(problem, fix="Train it again.")
