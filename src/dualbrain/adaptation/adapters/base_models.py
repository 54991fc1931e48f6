"""Base models for adaptation: a language model of the manifest, or a packaged adapter together with its model."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dualbrain.adaptation.adapters.card import read_adapter_card
from dualbrain.adaptation.adapters.packaged import packaged_folder, packaged_names
from dualbrain.adaptation.adapters.stacking import load_stack
from dualbrain.core.weights import MANIFEST, find_weight_file, locate_weights
from dualbrain.errors import UnknownNameError


@dataclass(frozen=True, slots=True, kw_only=True)
class BaseModel:
    """A base model that an adapter is trained on.

    `gguf` is the verified GGUF file of the language model and `gguf_sha256` its SHA-256. If the base is a packaged
    adapter, `stacked_on` lists the folders of the adapters that are merged into the model, the lowest first, and
    `stacked_on_id` is the id of the topmost one.
    """

    name: str
    gguf: Path
    gguf_sha256: str
    stacked_on: tuple[Path, ...] = ()
    stacked_on_id: str = ""

    @property
    def sha256(self) -> str:
        """The hash that identifies the base in a card: the id of the topmost adapter, else that of the GGUF file."""
        return self.stacked_on_id or self.gguf_sha256


def base_model_hash(name: str) -> str:
    """The hash that identifies the base called `name` in a card. The model file need not be in the cache.

    Raises `UnknownNameError`, and `ConfigurationError` for a damaged packaged adapter.
    """
    require_base_model(name)
    return read_adapter_card(packaged_folder(name)).id if name in packaged_names() else find_weight_file(name).sha256


def require_base_model(name: str) -> None:
    """Raise `UnknownNameError` unless `name` is a language model of the manifest or a packaged adapter."""
    models = tuple(file.name for file in MANIFEST.values() if file.filename.endswith(".gguf"))
    if name not in (known := (*models, *packaged_names())):
        raise UnknownNameError("base", name, known)


def find_base_model(name: str, cache: Path) -> BaseModel:
    """The base called `name`, with every file verified against its hash.

    Raises `UnknownNameError`, `MissingDependencyError`, `ChecksumError` or `ConfigurationError`.
    """
    require_base_model(name)
    if name not in packaged_names():
        return BaseModel(name=name, gguf=locate_weights(name, cache), gguf_sha256=find_weight_file(name).sha256)
    stack = load_stack(packaged_folder(name), cache)
    folders = tuple(layer.folder for layer in stack.layers)
    return BaseModel(
        name=name,
        gguf=stack.gguf,
        gguf_sha256=find_weight_file(stack.base).sha256,
        stacked_on=folders,
        stacked_on_id=stack.top_card.id,
    )
