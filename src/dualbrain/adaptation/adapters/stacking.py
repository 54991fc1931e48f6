"""What an adapter sits on: the untouched GGUF, and on that perhaps another adapter that comes with dualbrain."""

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
    """One adapter as it lies in its folder, verified."""

    folder: Path
    card: AdapterCard


@dataclass(frozen=True, slots=True)
class AdapterStack:
    """A base and the adapters on it, the lowest first; all are worn at once, each at full strength.

    W x + B₁A₁x + B₂A₂x: an adapter that was fitted on a base that wears another needs that other when it serves.
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
        """What the served adapter was fitted on."""
        return AdapterStack(self.base, self.gguf, self.layers[:-1])


def adapter_author(card: AdapterCard) -> str:
    """What is recorded as the author of what an adapter proposes: base and adapter."""
    return f"{card.base}+{card.id[:16]}"


def load_stack(folder: Path, cache: Path) -> AdapterStack:
    """The adapter in `folder` and everything it sits on, each plain LoRA and found to be what its card names.

    So what one engine refuses of an adapter, none serves. Raises as `layers_of` and `read_lora` do, and `MissingPart`,
    `WrongHash` for the base.
    """
    layers = read_layers(folder)
    for layer in layers:
        read_lora(layer.folder)
    lowest = layers[0].card.base
    return AdapterStack(lowest, locate_weights(lowest, cache), layers)


def read_layers(folder: Path) -> tuple[AdapterLayer, ...]:
    """The adapter in `folder` and those it sits on, the lowest first; the base itself need not be here.

    Raises `InvalidSetup` for changed weights or a base of another hash, `UnknownName`.
    """
    layers = [AdapterLayer(folder, read_adapter_card(folder))]
    while layers[0].card.base in packaged_names():
        beneath = packaged_folder(layers[0].card.base)
        layers.insert(0, AdapterLayer(beneath, read_adapter_card(beneath)))
        _require_base_hash(layers[1].card, layers[0].card.id)
        if len(layers) > len(packaged_names()) + 1:
            raise ConfigurationError(
                "packaged adapter", got="one that sits on itself", allowed="one that sits on a model"
            )
    lowest = layers[0].card
    _require_base_hash(lowest, find_weight_file(lowest.base).sha256)
    return tuple(layers)


def _require_base_hash(card: AdapterCard, found: str) -> None:
    if card.base_sha256 != found:
        fix = f"The adapter {card.id[:16]} was made for another {card.base}: fit it anew."
        raise ConfigurationError(f"hash of the base {card.base!r}", got=found, allowed=card.base_sha256, fix=fix)
