"""Cache of derived files for llama.cpp, made when first needed and verified at every use.

The files are adapters as GGUF-LoRA, and small bases in half precision.
"""

from __future__ import annotations

from collections.abc import Callable
from math import prod
from pathlib import Path

from dualbrain.adaptation.adapters.card import CONFIG_FILE, hash_metadata_files
from dualbrain.adaptation.adapters.stacking import AdapterLayer, AdapterStack
from dualbrain.adaptation.conversion.gguf_base import read_gguf_base
from dualbrain.adaptation.conversion.gguf_lora import CONVERTER_VERSION, convert_adapter
from dualbrain.adaptation.conversion.merged_gguf import write_merged_gguf
from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.core.storage.checksum import file_sha256
from dualbrain.core.storage.private_files import open_private_folder, tighten
from dualbrain.core.weights import find_weight_file
from dualbrain.planner.backends.llama_process import LoadedAdapter

MAX_HALF_PRECISION_BYTES = 512e6
"""Largest size [bytes] of a base in half precision; a larger base is served as it is."""


def prepare_base(stack: AdapterStack, cache: Path) -> Path:
    """The base file for the adapters of `stack`: a small quantised base in float16, any other base unchanged.

    For a 4-bit matrix llama.cpp rounds activations to 8 bits, which training does not do, so near-ties may be decided
    differently (docs/reference/planners.md).
    """
    path = base_path(stack, cache)
    return path if path == stack.gguf else _make_if_missing(path, lambda: write_merged_gguf({}, stack.gguf, path))


def base_path(stack: AdapterStack, cache: Path) -> Path:
    """The path of that file, whether it exists or not.

    Reading the tensors of a base takes seconds, so they are read only if file size and cache do not decide.
    """
    path = _cache_folder(cache) / f"{stack.base}-{find_weight_file(stack.base).sha256[:16]}-f16.gguf"
    size = stack.gguf.stat().st_size
    # With 8 bits or fewer per number it is too large in half precision; with more, half precision has no benefit.
    if size > MAX_HALF_PRECISION_BYTES / 2:
        return stack.gguf
    if path.is_file():
        return path
    in_half = 2 * sum(prod(shape) for shape in read_gguf_base(stack.gguf).shapes.values())
    if in_half > MAX_HALF_PRECISION_BYTES or size > in_half:
        return stack.gguf
    return path


def prepare_adapters(stack: AdapterStack, cache: Path) -> tuple[LoadedAdapter, ...]:
    """The adapters of `stack` as files for llama.cpp, the lowest first."""
    return tuple(
        LoadedAdapter(_converted_adapter(layer, stack, _cache_folder(cache)), layer.card.id) for layer in stack.layers
    )


def _cache_folder(cache: Path) -> Path:
    folder = cache / "adapters"
    open_private_folder(folder)
    return folder


def _converted_adapter(layer: AdapterLayer, stack: AdapterStack, folder: Path) -> Path:
    base = find_weight_file(stack.base).sha256
    config = hash_metadata_files(layer.folder)[CONFIG_FILE]  # the config contains α
    path = folder / f"{layer.card.id[:32]}-{config[:16]}-on-{base[:16]}-v{CONVERTER_VERSION}.gguf"
    return _make_if_missing(path, lambda: convert_adapter(layer.folder, stack.gguf, path))


def _make_if_missing(path: Path, make: Callable[[], object]) -> Path:
    """The file at `path`; it is made again if it is incomplete or changed."""
    if not _is_intact(path):
        stamp = path.with_suffix(".sha256")
        stamp.unlink(missing_ok=True)
        make()
        tighten(path)
        write_atomically(stamp, file_sha256(path).encode())
    return path


def _is_intact(path: Path) -> bool:
    """Whether the file exists with its original content."""
    stamp = path.with_suffix(".sha256")
    return path.is_file() and stamp.is_file() and file_sha256(path) == stamp.read_text()
