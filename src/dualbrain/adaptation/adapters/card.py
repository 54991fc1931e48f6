"""What an adapter is, in one file beside it: which weights, from what base and data, by which dials, how it did."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable
from pathlib import Path

import msgspec

from dualbrain.adaptation.config import AdaptConfig
from dualbrain.adaptation.early_stopping import HeldOutResult
from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.errors import DECODE_ERRORS, ConfigurationError, MissingDependencyError

CARD_FILE, WEIGHTS_FILE, CONFIG_FILE = "adapter.json", "adapter_model.safetensors", "adapter_config.json"
METADATA_FILES = (CONFIG_FILE, CARD_FILE)
"""What says how the weights are worn, and where: α among them. The id does not cover these two."""


TORCH_SUFFIX = " in torch"
"""What follows the name of a bare model, as the author of a proposal, where transformers ran it and not llama.cpp."""


class AdapterCard(msgspec.Struct, frozen=True, kw_only=True):
    """`id` is the SHA-256 of the weights: never given to other weights. `base` and `base_sha256` name what it sits on.

    It is of use with this `robot`, `registry` (vocabulary) and `prompt` (template) only, and with the vocabularies of
    further robots that it was taught, `also`, by name. `dataset` is the hash of what it was taught, `sources` counts
    who proposed that; `bootstrapped` is true if it was anybody but the base itself.
    `held_out` is what the fit saw, in torch and on few questions: no measure to promote it by.
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


def hash_weights(folder: Path) -> str:
    """SHA-256 of the weights in `folder`."""
    path = folder / WEIGHTS_FILE
    if not path.is_file():
        raise MissingDependencyError(f"The adapter {folder}", fix="Make one with `dualbrain adapt`.")
    return hashlib.sha256(path.read_bytes()).hexdigest()


def write_adapter_card(card: AdapterCard, folder: Path) -> None:
    """Write `card` beside the weights."""
    write_atomically(folder / CARD_FILE, msgspec.json.format(msgspec.json.encode(card), indent=2))


def read_adapter_card(folder: Path) -> AdapterCard:
    """The card in `folder`; raises `InvalidSetup` if it cannot be read or the weights are not those that it names."""
    path = folder / CARD_FILE
    found = hash_weights(folder)
    try:
        card = msgspec.json.decode(path.read_bytes(), type=AdapterCard)
    except (OSError, *DECODE_ERRORS) as error:
        raise ConfigurationError(
            "adapter card", got=str(error), allowed="as this program writes it", fix=str(path)
        ) from error
    if card.id != found:
        raise ConfigurationError(
            "adapter weights", got=found, allowed=card.id, fix=f"They were changed: do not use. {folder}"
        )
    return card


def hash_metadata_files(folder: Path) -> dict[str, str]:
    """SHA-256 of each file of `BESIDE` in `folder`, "" for one that is not there."""
    paths = ((name, folder / name) for name in METADATA_FILES)
    return {name: hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "" for name, path in paths}


def require_metadata_files(folder: Path, recorded: dict[str, str]) -> None:
    """Raise `InvalidSetup` if a file of `BESIDE` in `folder` is not the one `recorded`; one not recorded may be any."""
    found = hash_metadata_files(folder)
    for name, digest in recorded.items():
        if found[name] != digest:
            fix = f"It was changed: do not use. {folder}"
            raise ConfigurationError(f"{name} of adapter", got=found[name] or "no file", allowed=digest, fix=fix)


def read_lora_config(folder: Path) -> object:
    """What the config in `folder` says of how the weights are worn; which peft wrote it does not matter."""
    data = (folder / CONFIG_FILE).read_bytes()
    try:
        told = msgspec.json.decode(data, type=dict[str, object])
    except DECODE_ERRORS:
        return data
    return {name: value for name, value in told.items() if name != "peft_version"}


def has_foreign_proposals(sources: Iterable[str], base: str, own_adapters: Collection[str] = ()) -> bool:
    """Whether any of `sources` is another than `base`, bare (whatever runs it) or with one of its `own` adapters.

    `own` are the ids of adapters that were taught by the base alone: what others taught one, it passes on.
    """
    mine = {base, base + TORCH_SUFFIX, *(f"{base}+{one[:16]}" for one in own_adapters)}
    return not mine.issuperset(sources)
