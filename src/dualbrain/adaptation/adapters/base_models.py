"""What an adapter is fitted on: a model by name, or a packaged adapter together with the model that it sits on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dualbrain.adaptation.adapters.card import read_adapter_card
from dualbrain.adaptation.adapters.packaged import packaged_folder, packaged_names
from dualbrain.adaptation.adapters.stacking import stack_of
from dualbrain.core.weights import MANIFEST, find_file, locate
from dualbrain.errors import UnknownName


@dataclass(frozen=True, slots=True)
class Base:
    """The model that is adapted: its name, its verified GGUF with the hash of that, the adapters that it `wears`."""

    name: str
    gguf: Path
    gguf_sha256: str
    wears: tuple[Path, ...] = ()
    worn: str = ""

    @property
    def sha256(self) -> str:
        """What names it in a card: the hash of the file, or the id of the adapter on top of it."""
        return self.worn or self.gguf_sha256


def hash_of_base(name: str) -> str:
    """What names the base called `name` in a card; raises `UnknownName`, `InvalidSetup`. Its model need not be here."""
    require_base(name)
    return read_adapter_card(packaged_folder(name)).id if name in packaged_names() else find_file(name).sha256


def require_base(name: str) -> None:
    """Raise `UnknownName` unless `name` is a language model of the manifest or a packaged adapter."""
    models = tuple(file.name for file in MANIFEST.values() if file.filename.endswith(".gguf"))
    if name not in (known := (*models, *packaged_names())):
        raise UnknownName("base", name, known)


def find_base(name: str, cache: Path) -> Base:
    """The base called `name`, a language model of the manifest or a packaged adapter; every file as it is named.

    Raises `UnknownName`, `MissingPart`, `WrongHash`, `InvalidSetup`.
    """
    require_base(name)
    if name not in packaged_names():
        return Base(name, locate(name, cache), find_file(name).sha256)
    stack = stack_of(packaged_folder(name), cache)
    folders = tuple(layer.folder for layer in stack.layers)
    return Base(name, stack.gguf, find_file(stack.base).sha256, folders, stack.top.id)
