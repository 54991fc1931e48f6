"""A data set on disk: two files of JSON lines, and a card with its description and the hash of both files."""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import msgspec

from dualbrain.adaptation.curation.curate import CurationConfig, CurationResult
from dualbrain.adaptation.curation.sample import Sample, decode_samples, encode_samples
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.core.storage.private_files import create_private_folder
from dualbrain.core.text import describe_differences
from dualbrain.core.untrusted.bounded_file import read_bounded_file
from dualbrain.errors import DECODE_ERRORS, ConfigurationError, MissingDependencyError
from dualbrain.planner.prompt.short_prompt import short_template_hash

MAX_CARD_BYTES, MAX_SAMPLES_BYTES = 16 << 20, 1 << 30
"""Largest sizes of the card, and of one file of samples."""

TRAIN_FILE, HELD_OUT_FILE, CARD_FILE = "train.jsonl", "held_out.jsonl", "dataset.json"
SAMPLE_FORMAT = "conversational prompt-completion, JSON lines"


class DatasetCard(msgspec.Struct, frozen=True, kw_only=True):
    """Description and origin of a data set; `hash` is that of the bytes of both files.

    `ledger` is the hash of the newest event that was read, `event` its number, `memories` the number of memories.
    `left_out` counts excluded episodes by reason, `merged` the near-duplicates that a sample represents. `train`,
    `held_out` and `scenes` are numbers of samples and scenes, `shown` is the number of samples per epoch with
    repetitions. `sources` counts samples and near-duplicates by the planner that proposed them. `prompt` is the hash of
    the prompt template, `registry` that of the robot's skill vocabulary, `also` those of further robots by name, `site`
    that of the narrower vocabulary of a site ("" without one). `use_memories_of`: the robots of a shared ledger whose
    memories could be selected (empty: all). The other fields are the settings of curation; older cards lack `physical`
    and `use_memories_of`. `scene_values`: the scenes of the prompts state fitting parameter values.
    """

    hash: str
    form: str
    robot: str
    registry: str
    prompt: str
    ledger: str
    event: int
    memories: int
    train: int
    held_out: int
    shown: int
    scenes: int
    merged: int
    left_out: dict[str, int]
    sources: dict[str, int]
    epsilon: float
    slowest: float
    most_repeats: int
    share_held_out: float
    salt: str
    also: dict[str, str] = {}
    physical: bool | None = None
    site: str = ""
    scene_values: bool = False
    use_memories_of: tuple[str, ...] | None = None


class Dataset(msgspec.Struct, frozen=True):
    """A data set: its card, training samples and held-out samples."""

    card: DatasetCard
    train: tuple[Sample, ...]
    held_out: tuple[Sample, ...]


def assemble_dataset(
    curated: CurationResult, registry: SkillRegistry, config: CurationConfig, *, site: SkillRegistry | None = None
) -> Dataset:
    """The data set with its card; `site` is the narrower vocabulary of the site whose episodes were read too."""
    rows = (*curated.train, *curated.held_out)
    card = DatasetCard(
        hash=dataset_hash(encode_samples(curated.train), encode_samples(curated.held_out)),
        form=SAMPLE_FORMAT,
        robot=registry.robot,
        registry=registry.hash,
        prompt=short_template_hash(),
        ledger=curated.head.hash,
        event=curated.head.seq,
        memories=curated.memories,
        train=len(curated.train),
        held_out=len(curated.held_out),
        shown=sum(row.repeats for row in curated.train),
        scenes=len({row.scene for row in rows}),
        merged=curated.merged,
        left_out={reason: len(names) for reason, names in curated.left_out.items()},
        sources=dict(sorted(Counter(source for row in rows for source in _sources(row)).items())),
        epsilon=config.rules.epsilon,
        slowest=config.rules.slowest,
        most_repeats=config.most_repeats,
        share_held_out=config.held_out,
        salt=config.salt,
        physical=config.rules.physical,
        site=site.hash if site else "",
        use_memories_of=curated.writers,
    )
    return Dataset(card, curated.train, curated.held_out)


def _sources(row: Sample) -> tuple[str, ...]:
    return (row.source, *(one.source for one in row.others))


def curation_differences(card: DatasetCard, config: CurationConfig) -> str:
    """The settings of curation in `config` that differ from those of `card`, in words; "" if none does."""
    rules, made = config.rules, {"epsilon": card.epsilon, "slowest": card.slowest, "most_repeats": card.most_repeats}
    made |= {"held_out": card.share_held_out, "salt": card.salt}
    if card.physical is not None:
        made["physical"] = card.physical
    here = {"epsilon": rules.epsilon, "slowest": rules.slowest, "physical": rules.physical}
    return describe_differences(
        made, here | {"most_repeats": config.most_repeats, "held_out": config.held_out, "salt": config.salt}
    )


def card_differences(card: DatasetCard, expected: Mapping[str, object]) -> str:
    """The entries `expected` of the card, and the prompt template, that differ in `card`, in words; "" if none does."""
    here = {"prompt": short_template_hash(), **expected}
    return describe_differences({part: getattr(card, part) for part in here}, here)


def require_questions_for(card: DatasetCard, robot: str, registry: str) -> None:
    """Raise `ConfigurationError` unless the samples of `card` ask `robot` in its present vocabulary and prompt.

    `registry` is the hash of the vocabulary. A prompt contains this hash, and its answer repeats it: the gate rejects
    every answer to a question about another vocabulary.
    """
    fix = "Make the data set again with `dualbrain adapt --export FOLDER`."
    hashes = {card.robot: card.registry} | card.also
    if robot not in hashes:
        problem = f"The data set is for {', '.join(sorted(hashes))}, but the adapter is for {robot}."
        raise ConfigurationError.stating(problem, fix="Name a data set of that robot.")
    if hashes[robot] != registry:
        problem = f"The data set has the vocabulary {hashes[robot]} of {robot}, but the present one is {registry}."
        raise ConfigurationError.stating(problem, fix=fix)
    if card.prompt != (present := short_template_hash()):
        problem = f"The data set has the prompt template {card.prompt}, but the present one is {present}."
        raise ConfigurationError.stating(problem, fix=fix)


def dataset_hash(train: bytes, held_out: bytes) -> str:
    """SHA-256 over the hashes of both files: it changes if a file changes or a line moves from one to the other."""
    parts = hashlib.sha256(train).digest() + hashlib.sha256(held_out).digest()
    return hashlib.sha256(parts).hexdigest()


def write_dataset(dataset: Dataset, folder: Path) -> None:
    """Write both files and then the card; continues a write that was interrupted.

    Raises `ConfigurationError` if `folder` contains another data set or other files of these names, `FileWriteError`.
    """
    create_private_folder(folder)
    contents = {TRAIN_FILE: encode_samples(dataset.train), HELD_OUT_FILE: encode_samples(dataset.held_out)}
    if _has_other_dataset(folder, dataset.card.hash, contents):
        fix = f"Name an empty folder. {folder}"
        raise ConfigurationError.stating("The folder contains another data set.", fix=fix)
    for name, content in contents.items():
        write_atomically(folder / name, content)
    write_atomically(folder / CARD_FILE, msgspec.json.format(msgspec.json.encode(dataset.card), indent=2))


def _has_other_dataset(folder: Path, new_hash: str, contents: Mapping[str, bytes]) -> bool:
    """Whether `folder` has the card of another data set, or without a card files with other `contents`."""
    if (folder / CARD_FILE).exists():
        return read_dataset_card(folder).hash != new_hash
    found = {name: folder / name for name in contents if (folder / name).exists()}
    return any(
        path.stat().st_size != len(contents[name]) or path.read_bytes() != contents[name]
        for name, path in found.items()
    )


def read_dataset_card(folder: Path) -> DatasetCard:
    """The card in `folder`.

    Raises `MissingDependencyError` if there is none, `ConfigurationError` if it is unreadable.
    """
    path = folder / CARD_FILE
    if not path.is_file():
        raise MissingDependencyError(
            f"The data set {os.fspath(folder)}", fix="Make it with `dualbrain adapt --export FOLDER`."
        )
    try:
        return msgspec.json.decode(read_bounded_file(path, MAX_CARD_BYTES), type=DatasetCard)
    except DECODE_ERRORS as error:
        fix = f"Restore it from a backup, or make the data set again. {path}"
        raise ConfigurationError.stating(f"The data set card cannot be read: {error}.", fix=fix) from error


def read_dataset(folder: Path) -> Dataset:
    """The data set in `folder`.

    Raises `ConfigurationError` if its hash is not that of the card, or if this version cannot read its samples.
    """
    card = read_dataset_card(folder)
    train, held_out = (read_bounded_file(folder / name, MAX_SAMPLES_BYTES) for name in (TRAIN_FILE, HELD_OUT_FILE))
    if (got := dataset_hash(train, held_out)) != card.hash:
        problem = f"A file of the data set was changed: its hash is {got}, expected {card.hash}."
        raise ConfigurationError.stating(problem, fix=f"Make the data set again. {folder}")
    try:
        return Dataset(card, decode_samples(train), decode_samples(held_out))
    except DECODE_ERRORS as error:
        problem = f"A sample of the data set cannot be read: {error}. Another version or program wrote it."
        raise ConfigurationError.stating(problem, fix=f"Make the data set again. {folder}") from error
