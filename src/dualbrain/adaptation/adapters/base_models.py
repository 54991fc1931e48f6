"""What an adapter is fitted on: a model by name, or a packaged adapter together with the model that it sits on."""

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
    """The model that is adapted: its name, its verified GGUF with the hash of that, the adapters that it `wears`."""

    name: str
    gguf: Path
    gguf_sha256: str
    stacked_on: tuple[Path, ...] = ()
    stacked_on_id: str = ""

    @property
    def sha256(self) -> str:
        """What names it in a card: the hash of the file, or the id of the adapter on top of it."""
        return self.stacked_on_id or self.gguf_sha256


def base_model_hash(name: str) -> str:
    """What names the base called `name` in a card; raises `UnknownName`, `InvalidSetup`. Its model need not be here."""
    require_base_model(name)
    return read_adapter_card(packaged_folder(name)).id if name in packaged_names() else find_weight_file(name).sha256


def require_base_model(name: str) -> None:
    """Raise `UnknownName` unless `name` is a language model of the manifest or a packaged adapter."""
    models = tuple(file.name for file in MANIFEST.values() if file.filename.endswith(".gguf"))
    if name not in (known := (*models, *packaged_names())):
        raise UnknownNameError("base", name, known)


def find_base_model(name: str, cache: Path) -> BaseModel:
    """The base called `name`, a language model of the manifest or a packaged adapter; every file as it is named.

    Raises `UnknownName`, `MissingPart`, `WrongHash`, `InvalidSetup`.
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
