"""What a converter must know of a base in GGUF: architecture, heads, and where each linear layer went."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dualbrain.errors import ConfigurationError, MissingDependencyError

PERMUTED_ARCHITECTURES, UNPERMUTED_ARCHITECTURES = frozenset({"llama"}), frozenset({"qwen2"})
"""Architectures whose q and k rows llama.cpp keeps in another order than transformers, and those where it does not.
Others are refused until a golden test shows that they answer alike."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GgufBase:
    """`shapes` are (in, out) by tensor name; `heads` counts query heads, `kv_heads` those of keys and values."""

    architecture: str
    heads: int
    kv_heads: int
    shapes: dict[str, tuple[int, ...]]
    tensor_name_of: Callable[[str], str | None]

    @property
    def is_permuted(self) -> bool:
        """Whether the rows of q and k are in the order of rotary pairs."""
        return self.architecture in PERMUTED_ARCHITECTURES

    def find_tensor(self, module: str) -> str:
        """The tensor that the adapter of `module` sits on; raises `InvalidSetup` if it is no layer of a block.

        Embeddings and the output matrix are refused: the objective takes them for frozen.
        """
        name = self.tensor_name_of(module)
        if name is None or not name.startswith("blk.") or f"{name}.weight" not in self.shapes:
            raise ConfigurationError("LoRA layer", got=module, allowed="a linear layer of this base's blocks")
        return f"{name}.weight"


def read_gguf_base(path: Path) -> GgufBase:
    """The facts of the GGUF at `path`; raises `InvalidSetup` for one that is not understood, `MissingPart`."""
    try:
        import gguf  # noqa: PLC0415  (only where an adapter is served)
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            "The package gguf", fix="Install it with `pip install 'dualbrain[planner]'`."
        ) from error
    try:
        reader = gguf.GGUFReader(path)
    except (ValueError, IndexError, KeyError) as error:
        raise ConfigurationError("base", got=str(error), allowed="a GGUF file", fix=str(path)) from error
    architecture = _read_field(reader, "general.architecture", str)
    if architecture not in PERMUTED_ARCHITECTURES | UNPERMUTED_ARCHITECTURES:
        known = ", ".join(sorted(PERMUTED_ARCHITECTURES | UNPERMUTED_ARCHITECTURES))
        raise ConfigurationError(
            "architecture of the base", got=architecture, allowed=known, fix="Serve it with torch."
        )
    kind = {name: arch for arch, name in gguf.MODEL_ARCH_NAMES.items()}[architecture]
    names = gguf.get_tensor_name_map(kind, _read_field(reader, f"{architecture}.block_count", int))
    return GgufBase(
        architecture=architecture,
        heads=_read_field(reader, f"{architecture}.attention.head_count", int),
        kv_heads=_read_field(reader, f"{architecture}.attention.head_count_kv", int),
        shapes={tensor.name: tuple(int(n) for n in tensor.shape) for tensor in reader.tensors},
        tensor_name_of=names.get_name,
    )


def _read_field(reader: Any, key: str, kind: type[Any]) -> Any:
    found = reader.get_field(key)
    value = None if found is None else found.contents()
    if not isinstance(value, kind):
        raise ConfigurationError(f"{key} of the base", got=value, allowed=f"one {kind.__name__}")
    return value


def write_gguf_file(writer: Any) -> None:
    """Everything that was added to the `GGUFWriter`, in the order of the format, and the file closed in any case."""
    try:
        writer.write_header_to_file()
        writer.write_kv_data_to_file()
        writer.write_tensors_to_file()
    finally:
        writer.close()
