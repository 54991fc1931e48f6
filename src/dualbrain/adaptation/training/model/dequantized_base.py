"""A base as torch reads it, in the cache: made from its GGUF when first needed, verified whenever used."""

# pyright: reportMissingImports=false

from __future__ import annotations

import fcntl
import hashlib
import shutil
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

import msgspec
import torch
from safetensors import SafetensorError
from transformers import AutoModelForCausalLM, AutoTokenizer
from transformers.utils import logging

from dualbrain.adaptation.adapters.base_models import BaseModel
from dualbrain.core.storage.atomic_files import FileWriteError, fsync_folder
from dualbrain.errors import DECODE_ERRORS, ConfigurationError, MissingDependencyError

STAMP_FILE = "made.json"
CONVERTER_PACKAGES = ("transformers", "gguf")
"""Whose versions may change what comes out."""


class ConversionStamp(msgspec.Struct, frozen=True):
    """The stamp in a folder: of which GGUF it was made, by which versions, and the SHA-256 of each file in it."""

    source: str
    versions: dict[str, str]
    files: dict[str, str]


def dequantize_base(base: BaseModel, cache: Path) -> Path:
    """The folder in `cache` that holds `base` without what it wears, in float32: 4 bytes a number.

    Block scales times quanta, as llama.cpp does it. Made the first time, and again if a file in it is not the one that
    was written, or other versions wrote it. Raises `MissingPart`, `DiskFull`, and `InvalidSetup` for a GGUF that
    transformers cannot read or that lacks weights.
    """
    logging.disable_progress_bar()  # our own progress is told line by line
    folder = cache / "torch" / base.gguf_sha256[:32]
    if not _is_intact(folder, base):
        if not base.gguf.is_file():
            fix = f"Get it with `dualbrain models fetch`. {base.gguf}"
            raise MissingDependencyError(f"The model file {base.gguf.name!r}", fix=fix)
        with _translate_write_errors(folder), _exclusive_lock(folder):
            if not _is_intact(folder, base):
                _convert(base, folder)
    return folder


def _is_intact(folder: Path, base: BaseModel) -> bool:
    """Whether `folder` holds what was made of this base by these versions, to the byte."""
    try:
        made = msgspec.json.decode((folder / STAMP_FILE).read_bytes(), type=ConversionStamp)
        return made == ConversionStamp(base.gguf_sha256, _versions(), _file_hashes(folder))
    except (OSError, *DECODE_ERRORS):
        return False


def _convert(base: BaseModel, folder: Path) -> None:
    """Put the model as safetensors with its tokenizer at `folder`, whole or not at all."""
    model, tokenizer = _load_gguf(base.gguf)
    for left in folder.parent.glob(f".{folder.name}-*"):  # by one that was killed
        shutil.rmtree(left, ignore_errors=True)
    beside = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}-"))
    try:
        model.save_pretrained(beside / "new", safe_serialization=True)
        tokenizer.save_pretrained(beside / "new")
        made = ConversionStamp(base.gguf_sha256, _versions(), _file_hashes(beside / "new"))
        (beside / "new" / STAMP_FILE).write_bytes(msgspec.json.encode(made))
        if folder.is_dir():
            folder.rename(beside / "old")
        (beside / "new").rename(folder)
        fsync_folder(folder.parent)
    finally:
        shutil.rmtree(beside, ignore_errors=True)


@torch.no_grad()
def _load_gguf(gguf: Path) -> tuple[Any, Any]:
    """Model in float32 and tokenizer of a GGUF, with every weight that the model has."""
    try:
        loaded: Any = AutoModelForCausalLM.from_pretrained(
            gguf.parent, gguf_file=gguf.name, dtype=torch.float32, output_loading_info=True
        )
        tokenizer = AutoTokenizer.from_pretrained(gguf.parent, gguf_file=gguf.name)
    except (OSError, ValueError) as error:
        allowed = "a language model as transformers reads it"
        raise ConfigurationError("GGUF of the base", got=str(error), allowed=allowed, fix=str(gguf)) from error
    packed, told = loaded
    facts = {k: v for k, v in packed.config.to_dict().items() if k not in ("quantization_config", "_name_or_path")}
    plain = type(packed)(type(packed.config)(**facts))
    lacking = {*told["missing_keys"], *plain.load_state_dict(packed.state_dict(), strict=False).missing_keys}
    if lacking:  # they would be drawn at random
        got = f"no {', '.join(sorted(lacking))}"
        raise ConfigurationError("GGUF of the base", got=got, allowed="every weight of the model", fix=str(gguf))
    plain.tie_weights()
    return plain, tokenizer


def _versions() -> dict[str, str]:
    return {name: metadata.version(name) for name in CONVERTER_PACKAGES}


def _file_hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of each file in `folder` but the stamp."""
    found: dict[str, str] = {}
    for path in sorted(folder.iterdir()):
        if path.name != STAMP_FILE:
            with path.open("rb") as data:
                found[path.name] = hashlib.file_digest(data, "sha256").hexdigest()
    return found


@contextmanager
def _translate_write_errors(folder: Path) -> Generator[None]:
    """Inside, what cannot be written raises `DiskFull`; safetensors has an error of its own for that."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        yield
    except (OSError, SafetensorError) as error:
        raise FileWriteError(folder, error) from error


@contextmanager
def _exclusive_lock(folder: Path) -> Generator[None]:
    """Inside, no other process makes `folder`."""
    with folder.with_name(f".{folder.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
