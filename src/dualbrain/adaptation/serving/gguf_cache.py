"""GGUF-LoRA files made of adapters, kept in the cache: made when first needed, verified whenever they are used."""

from __future__ import annotations

import hashlib
from pathlib import Path

from dualbrain.adaptation.durable import write_durably
from dualbrain.adaptation.serving.gguf_lora import VERSION, convert
from dualbrain.adaptation.serving.layers import Layer, Stack
from dualbrain.planner.llama_process import Worn
from dualbrain.weights import find_file


def worn(stack: Stack, cache: Path) -> tuple[Worn, ...]:
    """The adapters of `stack` as files that llama.cpp loads, the lowest first."""
    folder = cache / "adapters"
    folder.mkdir(parents=True, exist_ok=True)
    return tuple(Worn(_made(layer, stack, folder), layer.card.id) for layer in stack.layers)


def _made(layer: Layer, stack: Stack, folder: Path) -> Path:
    """The file for `layer`; one that was torn or changed is made again."""
    base = find_file(stack.base).sha256
    path = folder / f"{layer.card.id[:32]}-on-{base[:16]}-v{VERSION}.gguf"
    stamp = path.with_suffix(".sha256")
    if not (path.is_file() and stamp.is_file() and _hash(path) == stamp.read_text()):
        stamp.unlink(missing_ok=True)
        convert(layer.folder, stack.gguf, path)
        write_durably(stamp, _hash(path).encode())
    return path


def _hash(path: Path) -> str:
    with path.open("rb") as data:
        return hashlib.file_digest(data, "sha256").hexdigest()
