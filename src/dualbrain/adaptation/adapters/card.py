"""What an adapter is, in one file beside it: which weights, from what base and data, by which dials, how it did."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable
from pathlib import Path

import msgspec

from dualbrain.adaptation.config import AdaptConfig
from dualbrain.adaptation.early_stopping import HeldOut
from dualbrain.core.storage.atomic_files import write_durably
from dualbrain.errors import UNREADABLE, InvalidSetup, MissingPart

CARD, WEIGHTS, CONFIG = "adapter.json", "adapter_model.safetensors", "adapter_config.json"
BESIDE = (CONFIG, CARD)
"""What says how the weights are worn, and where: α among them. The id does not cover these two."""


IN_TORCH = " in torch"
"""What follows the name of a bare model, as the author of a proposal, where transformers ran it and not llama.cpp."""


class AdapterCard(msgspec.Struct, frozen=True):
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
    held_out: HeldOut | None
    config: AdaptConfig
    versions: dict[str, str]
    also: dict[str, str] = {}


def weights_id(folder: Path) -> str:
    """SHA-256 of the weights in `folder`."""
    path = folder / WEIGHTS
    if not path.is_file():
        raise MissingPart(f"The adapter {folder}", fix="Make one with `dualbrain adapt`.")
    return hashlib.sha256(path.read_bytes()).hexdigest()


def write_card(card: AdapterCard, folder: Path) -> None:
    """Write `card` beside the weights."""
    write_durably(folder / CARD, msgspec.json.format(msgspec.json.encode(card), indent=2))


def read_adapter_card(folder: Path) -> AdapterCard:
    """The card in `folder`; raises `InvalidSetup` if it cannot be read or the weights are not those that it names."""
    path = folder / CARD
    found = weights_id(folder)
    try:
        card = msgspec.json.decode(path.read_bytes(), type=AdapterCard)
    except (OSError, *UNREADABLE) as error:
        raise InvalidSetup(
            "adapter card", got=str(error), allowed="as this program writes it", fix=str(path)
        ) from error
    if card.id != found:
        raise InvalidSetup(
            "adapter weights", got=found, allowed=card.id, fix=f"They were changed: do not use. {folder}"
        )
    return card


def hashes_beside(folder: Path) -> dict[str, str]:
    """SHA-256 of each file of `BESIDE` in `folder`, "" for one that is not there."""
    paths = ((name, folder / name) for name in BESIDE)
    return {name: hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "" for name, path in paths}


def require_beside(folder: Path, recorded: dict[str, str]) -> None:
    """Raise `InvalidSetup` if a file of `BESIDE` in `folder` is not the one `recorded`; one not recorded may be any."""
    found = hashes_beside(folder)
    for name, digest in recorded.items():
        if found[name] != digest:
            fix = f"It was changed: do not use. {folder}"
            raise InvalidSetup(f"{name} of adapter", got=found[name] or "no file", allowed=digest, fix=fix)


def worn_as(folder: Path) -> object:
    """What the config in `folder` says of how the weights are worn; which peft wrote it does not matter."""
    data = (folder / CONFIG).read_bytes()
    try:
        told = msgspec.json.decode(data, type=dict[str, object])
    except UNREADABLE:
        return data
    return {name: value for name, value in told.items() if name != "peft_version"}


def proposed_by_others(sources: Iterable[str], base: str, own: Collection[str] = ()) -> bool:
    """Whether any of `sources` is another than `base`, bare (whatever runs it) or with one of its `own` adapters.

    `own` are the ids of adapters that were taught by the base alone: what others taught one, it passes on.
    """
    mine = {base, base + IN_TORCH, *(f"{base}+{one[:16]}" for one in own)}
    return not mine.issuperset(sources)
