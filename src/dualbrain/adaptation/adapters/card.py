"""The adapter card: one JSON file beside the weights that records base, data set, settings and held-out results."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable
from pathlib import Path

import msgspec

from dualbrain.adaptation.config import AdaptConfig
from dualbrain.adaptation.early_stopping import HeldOutResult
from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.core.untrusted.bounded_file import read_bounded_file
from dualbrain.errors import DECODE_ERRORS, ConfigurationError, MissingDependencyError

MAX_METADATA_BYTES, MAX_WEIGHTS_BYTES = 16 << 20, 4 << 30
"""Largest sizes of the card or configuration, and of the weights of an adapter."""

CARD_FILE, WEIGHTS_FILE, CONFIG_FILE = "adapter.json", "adapter_model.safetensors", "adapter_config.json"
METADATA_FILES = (CONFIG_FILE, CARD_FILE)
"""Files that state the LoRA settings (α among them) and where the adapter may serve. The adapter id does not cover
them."""


TORCH_SUFFIX = " in torch"
"""Suffix of a proposal's author name if transformers, and not llama.cpp, ran a model without an adapter."""


class AdapterCard(msgspec.Struct, frozen=True, kw_only=True):
    """The record of one adapter.

    `id` is the SHA-256 of the weights. `base` and `base_sha256` identify the base model. The adapter is valid only for
    this `robot`, skill vocabulary (hash `registry`) and prompt template (hash `prompt`), and for the vocabularies of
    further robots in its training data: `also`, hash by robot. `dataset` is the hash of the training data set, and
    `sources` counts its samples by the planner that proposed them. `bootstrapped` is true if any planner other than the
    base itself proposed samples. `held_out` is the result during training, measured in torch on few questions;
    promotion needs a measurement of its own (`promotion`). `scene_values`: the scenes of its prompts state fitting
    parameter values.
    """

    id: str
    base: str
    base_sha256: str
    robot: str
    registry: str
    prompt: str
    dataset: str
    sources: dict[str, int]
    bootstrapped: bool
    precision: str
    steps: int
    held_out: HeldOutResult | None
    config: AdaptConfig
    versions: dict[str, str]
    also: dict[str, str] = {}
    scene_values: bool = False


def hash_weights(folder: Path) -> str:
    """SHA-256 of the weights in `folder`; raises `MissingDependencyError` if there are none."""
    path = folder / WEIGHTS_FILE
    if not path.is_file():
        raise MissingDependencyError(f"The adapter {folder}", fix="Make one with `dualbrain adapt`.")
    return hashlib.sha256(read_bounded_file(path, MAX_WEIGHTS_BYTES)).hexdigest()


def write_adapter_card(card: AdapterCard, folder: Path) -> None:
    """Write `card` beside the weights in `folder`; raises `FileWriteError`."""
    write_atomically(folder / CARD_FILE, msgspec.json.format(msgspec.json.encode(card), indent=2))


def read_adapter_card(folder: Path) -> AdapterCard:
    """The card in `folder`; raises `ConfigurationError` if it is unreadable or if the weights were changed."""
    path = folder / CARD_FILE
    found = hash_weights(folder)
    try:
        card = msgspec.json.decode(read_bounded_file(path, MAX_METADATA_BYTES), type=AdapterCard)
    except (ConfigurationError, *DECODE_ERRORS) as error:
        fix = f"Restore it from a backup, or train the adapter again. {path}"
        raise ConfigurationError.stating(f"The adapter card cannot be read: {error}.", fix=fix) from error
    if card.id != found:
        problem = f"The adapter weights were changed: their SHA-256 is {found}, expected {card.id}."
        raise ConfigurationError.stating(problem, fix=f"Do not use this adapter. {folder}")
    return card


def hash_metadata_files(folder: Path) -> dict[str, str]:
    """SHA-256 of each file of `METADATA_FILES` in `folder`; "" for a missing file."""
    paths = ((name, folder / name) for name in METADATA_FILES)
    return {
        name: hashlib.sha256(read_bounded_file(path, MAX_METADATA_BYTES)).hexdigest() if path.is_file() else ""
        for name, path in paths
    }


def require_metadata_files(folder: Path, recorded: dict[str, str]) -> None:
    """Raise `ConfigurationError` if a metadata file in `folder` differs from its `recorded` hash.

    A file without a recorded hash may have any content.
    """
    found = hash_metadata_files(folder)
    for name, digest in recorded.items():
        if found[name] != digest:
            problem = f"{name} of adapter {folder.name[:16]} was changed after the adapter was added: its SHA-256 is"
            problem += f" {found[name] or 'that of no file'}, expected {digest}."
            raise ConfigurationError.stating(problem, fix=f"Do not use this adapter. {folder}")


def read_lora_config(folder: Path) -> object:
    """The LoRA settings in `folder` without the version of peft that wrote them; raw bytes if they are not JSON."""
    data = read_bounded_file(folder / CONFIG_FILE, MAX_METADATA_BYTES)
    try:
        settings = msgspec.json.decode(data, type=dict[str, object])
    except DECODE_ERRORS:
        return data
    return {name: value for name, value in settings.items() if name != "peft_version"}


def has_foreign_proposals(sources: Iterable[str], base: str, own_adapters: Collection[str] = ()) -> bool:
    """Whether any of `sources` is a planner other than `base`, alone or with one of `own_adapters`.

    The suffix of the runtime is ignored. `own_adapters` are the ids of adapters trained only on proposals of the base;
    any other adapter carries over knowledge from other planners.
    """
    own = {base, base + TORCH_SUFFIX, *(f"{base}+{one[:16]}" for one in own_adapters)}
    return not own.issuperset(sources)
