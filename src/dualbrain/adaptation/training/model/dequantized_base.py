"""Cache of base models in torch's format: converted from GGUF when first needed, verified at every use."""

# pyright: reportMissingImports=false

from __future__ import annotations

import shutil
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
from dualbrain.core.storage.atomic_files import FileWriteError, atomic_folder
from dualbrain.core.storage.checksum import file_sha256
from dualbrain.core.storage.file_lock import file_lock
from dualbrain.errors import DECODE_ERRORS, ConfigurationError, MissingDependencyError

STAMP_FILE = "made.json"
CONVERTER_PACKAGES = ("transformers", "gguf")
"""Packages whose versions may change the conversion."""


class ConversionStamp(msgspec.Struct, frozen=True):
    """The stamp of a folder: hash of its GGUF source, versions of the converter, and the SHA-256 of each file."""

    source: str
    versions: dict[str, str]
    files: dict[str, str]


def dequantize_base(base: BaseModel, cache: Path) -> Path:
    """The folder in `cache` with `base` in float32, 4 bytes per number, without its stacked adapters.

    Weights are block scales times quanta, as in llama.cpp. The folder is made if it is missing, if a file in it was
    changed, or if other versions wrote it. Raises `MissingDependencyError`, `FileWriteError`, and `ConfigurationError`
    for a GGUF that transformers cannot read or that lacks weights.
    """
    logging.disable_progress_bar()  # dualbrain reports progress line by line
    folder = cache / "torch" / base.gguf_sha256[:32]
    if not _is_intact(folder, base):
        if not base.gguf.is_file():
            fix = f"Fetch it with `dualbrain models fetch`. {base.gguf}"
            raise MissingDependencyError(f"The model file {base.gguf.name!r}", fix=fix)
        with _translate_write_errors(folder), file_lock(folder.with_name(f".{folder.name}.lock")):
            if not _is_intact(folder, base):
                _convert(base, folder)
    return folder


def _is_intact(folder: Path, base: BaseModel) -> bool:
    """Whether `folder` has exactly the files that these versions made from this base."""
    try:
        stamp = msgspec.json.decode((folder / STAMP_FILE).read_bytes(), type=ConversionStamp)
        return stamp == ConversionStamp(base.gguf_sha256, _versions(), _file_hashes(folder))
    except (OSError, *DECODE_ERRORS):
        return False


def _convert(base: BaseModel, folder: Path) -> None:
    """Write the model as safetensors with its tokenizer to `folder`, complete or not at all."""
    model, tokenizer = _load_gguf(base.gguf)
    for leftover in folder.parent.glob(f".{folder.name}.????????"):  # of a process that was killed
        shutil.rmtree(leftover, ignore_errors=True)
    with atomic_folder(folder) as temporary:
        model.save_pretrained(temporary, safe_serialization=True)
        tokenizer.save_pretrained(temporary)
        stamp = ConversionStamp(base.gguf_sha256, _versions(), _file_hashes(temporary))
        (temporary / STAMP_FILE).write_bytes(msgspec.json.encode(stamp))
        if folder.is_dir():  # changed, or of other versions: the rename needs its place
            shutil.rmtree(folder)


@torch.no_grad()
def _load_gguf(gguf: Path) -> tuple[Any, Any]:
    """Model in float32 and tokenizer of a GGUF with all weights of the model; raises `ConfigurationError`."""
    try:
        loaded: Any = AutoModelForCausalLM.from_pretrained(
            gguf.parent, gguf_file=gguf.name, dtype=torch.float32, output_loading_info=True
        )
        tokenizer = AutoTokenizer.from_pretrained(gguf.parent, gguf_file=gguf.name)
    except (OSError, ValueError) as error:
        problem = f"transformers cannot read the GGUF of the base: {error}."
        raise ConfigurationError.stating(problem, fix=f"Choose another base. {gguf}") from error
    gguf_model, report = loaded
    settings = {
        k: v for k, v in gguf_model.config.to_dict().items() if k not in ("quantization_config", "_name_or_path")
    }
    plain = type(gguf_model)(type(gguf_model.config)(**settings))
    lacking = {*report["missing_keys"], *plain.load_state_dict(gguf_model.state_dict(), strict=False).missing_keys}
    if lacking:  # transformers would initialise them at random
        problem = f"The GGUF of the base has no {', '.join(sorted(lacking))}."
        raise ConfigurationError.stating(problem, fix=f"Choose another base. {gguf}")
    plain.tie_weights()
    return plain, tokenizer


def _versions() -> dict[str, str]:
    return {name: metadata.version(name) for name in CONVERTER_PACKAGES}


def _file_hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of each file in `folder` except the stamp."""
    found: dict[str, str] = {}
    for path in sorted(folder.iterdir()):
        if path.name != STAMP_FILE:
            found[path.name] = file_sha256(path)
    return found


@contextmanager
def _translate_write_errors(folder: Path) -> Generator[None]:
    """In this context, a failed write raises `FileWriteError`; safetensors has an error class of its own."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        yield
    except (OSError, SafetensorError) as error:
        raise FileWriteError(folder, error) from error
