"""Files for llama.cpp that are made of others, kept in the cache: made when first needed, verified whenever used.

They are adapters as GGUF-LoRA, and small bases in half precision.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from math import prod
from pathlib import Path

from dualbrain.adaptation.adapters.card import CONFIG, hashes_beside
from dualbrain.adaptation.adapters.stacking import Layer, Stack
from dualbrain.adaptation.conversion.gguf_base import read_gguf_base
from dualbrain.adaptation.conversion.gguf_lora import VERSION, convert
from dualbrain.adaptation.conversion.merged_gguf import write_merged
from dualbrain.core.storage.atomic_files import write_durably
from dualbrain.core.weights import find_file
from dualbrain.planner.backends.llama_process import Worn

SMALL = 512e6
"""Bytes of a base in half precision; a larger one is served as it is."""


def served(stack: Stack, cache: Path) -> Path:
    """The base file on which the adapters of `stack` are worn: of a small one that is quantised, the same in float16.

    For a 4-bit matrix llama.cpp rounds activations to 8 bits, which the fit did not do, and near-ties turn
    (docs/serving.md).
    """
    path = served_at(stack, cache)
    return path if path == stack.gguf else _made(path, lambda: write_merged({}, stack.gguf, path))


def served_at(stack: Stack, cache: Path) -> Path:
    """Where that file lies, or will when it is made.

    To read what a base holds takes seconds, so that is done only where size and cache do not decide.
    """
    path = _folder(cache) / f"{stack.base}-{find_file(stack.base).sha256[:16]}-f16.gguf"
    size = stack.gguf.stat().st_size
    if size > SMALL / 2:  # with 8 bits or less a number, too large in half precision; with more, as good as that
        return stack.gguf
    if path.is_file():
        return path
    in_half = 2 * sum(prod(shape) for shape in read_gguf_base(stack.gguf).shapes.values())
    if in_half > SMALL or size > in_half:
        return stack.gguf
    return path


def worn(stack: Stack, cache: Path) -> tuple[Worn, ...]:
    """The adapters of `stack` as files that llama.cpp loads, the lowest first."""
    return tuple(Worn(_converted(layer, stack, _folder(cache)), layer.card.id) for layer in stack.layers)


def _folder(cache: Path) -> Path:
    folder = cache / "adapters"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _converted(layer: Layer, stack: Stack, folder: Path) -> Path:
    base, scaled = find_file(stack.base).sha256, hashes_beside(layer.folder)[CONFIG]  # α is in the config
    path = folder / f"{layer.card.id[:32]}-{scaled[:16]}-on-{base[:16]}-v{VERSION}.gguf"
    return _made(path, lambda: convert(layer.folder, stack.gguf, path))


def _made(path: Path, make: Callable[[], object]) -> Path:
    """The file at `path`; one that was torn or changed is made again."""
    if not _is_whole(path):
        stamp = path.with_suffix(".sha256")
        stamp.unlink(missing_ok=True)
        make()
        write_durably(stamp, _hash(path).encode())
    return path


def _is_whole(path: Path) -> bool:
    """Whether the file is there, as it was made."""
    stamp = path.with_suffix(".sha256")
    return path.is_file() and stamp.is_file() and _hash(path) == stamp.read_text()


def _hash(path: Path) -> str:
    with path.open("rb") as data:
        return hashlib.file_digest(data, "sha256").hexdigest()
