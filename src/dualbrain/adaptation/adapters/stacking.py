"""What an adapter sits on: the untouched GGUF, and on that perhaps another adapter that comes with dualbrain."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dualbrain.adaptation.adapters.card import AdapterCard, read_adapter_card
from dualbrain.adaptation.adapters.packaged import packaged_folder, packaged_names
from dualbrain.adaptation.conversion.peft_lora import read_lora
from dualbrain.core.weights import find_file, locate
from dualbrain.errors import InvalidSetup


@dataclass(frozen=True, slots=True)
class Layer:
    """One adapter as it lies in its folder, verified."""

    folder: Path
    card: AdapterCard


@dataclass(frozen=True, slots=True)
class Stack:
    """A base and the adapters on it, the lowest first; all are worn at once, each at full strength.

    W x + B₁A₁x + B₂A₂x: an adapter that was fitted on a base that wears another needs that other when it serves.
    """

    base: str
    gguf: Path
    layers: tuple[Layer, ...]

    @property
    def top(self) -> AdapterCard:
        """The card of the adapter that is served."""
        return self.layers[-1].card

    @property
    def below(self) -> Stack:
        """What the served adapter was fitted on."""
        return Stack(self.base, self.gguf, self.layers[:-1])


def author_of(card: AdapterCard) -> str:
    """What is recorded as the author of what an adapter proposes: base and adapter."""
    return f"{card.base}+{card.id[:16]}"


def stack_of(folder: Path, cache: Path) -> Stack:
    """The adapter in `folder` and everything it sits on, each plain LoRA and found to be what its card names.

    So what one engine refuses of an adapter, none serves. Raises as `layers_of` and `read_lora` do, and `MissingPart`,
    `WrongHash` for the base.
    """
    layers = layers_of(folder)
    for layer in layers:
        read_lora(layer.folder)
    lowest = layers[0].card.base
    return Stack(lowest, locate(lowest, cache), layers)


def layers_of(folder: Path) -> tuple[Layer, ...]:
    """The adapter in `folder` and those it sits on, the lowest first; the base itself need not be here.

    Raises `InvalidSetup` for changed weights or a base of another hash, `UnknownName`.
    """
    layers = [Layer(folder, read_adapter_card(folder))]
    while layers[0].card.base in packaged_names():
        beneath = packaged_folder(layers[0].card.base)
        layers.insert(0, Layer(beneath, read_adapter_card(beneath)))
        _require(layers[1].card, layers[0].card.id)
        if len(layers) > len(packaged_names()) + 1:
            raise InvalidSetup("packaged adapter", got="one that sits on itself", allowed="one that sits on a model")
    lowest = layers[0].card
    _require(lowest, find_file(lowest.base).sha256)
    return tuple(layers)


def _require(card: AdapterCard, found: str) -> None:
    if card.base_sha256 != found:
        fix = f"The adapter {card.id[:16]} was made for another {card.base}: fit it anew."
        raise InvalidSetup(f"hash of the base {card.base!r}", got=found, allowed=card.base_sha256, fix=fix)
