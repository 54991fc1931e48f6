"""Facts about a base in GGUF that a converter needs: architecture, heads, and the tensor of each linear layer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dualbrain.errors import ConfigurationError, MissingDependencyError

PERMUTED_ARCHITECTURES, UNPERMUTED_ARCHITECTURES = frozenset({"llama"}), frozenset({"qwen2"})
"""Architectures whose rows of q and k llama.cpp permutes, and those whose rows it leaves in order. All others are
rejected until a golden test shows that both runtimes give the same answers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GgufBase:
    """A base model in GGUF.

    `shapes` are (in, out) by tensor name; `heads` is the number of query heads, `kv_heads` that of key and value heads;
    `tensor_name_of` maps a module name of transformers to a tensor name.
    """

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
        """The tensor of the linear layer `module`; raises `ConfigurationError` if it is not a layer of a block.

        Embeddings and the output matrix are rejected: the objective assumes that they are frozen.
        """
        name = self.tensor_name_of(module)
        if name is None or not name.startswith("blk.") or f"{name}.weight" not in self.shapes:
            raise ConfigurationError("LoRA layer", got=module, allowed="a linear layer of this base's blocks")
        return f"{name}.weight"


def read_gguf_base(path: Path) -> GgufBase:
    """The facts about the GGUF at `path`.

    Raises `ConfigurationError` if the file cannot be used, `MissingDependencyError` without the package gguf.
    """
    try:
        import gguf  # noqa: PLC0415  (only where an adapter is served)
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            "The package gguf", fix="Install it with `pip install 'dualbrain[planner]'`."
        ) from error
    try:
        reader = gguf.GGUFReader(path)
    except (ValueError, IndexError, KeyError) as error:
        fix = f"Fetch it again with `dualbrain models fetch`. {path}"
        raise ConfigurationError.stating(f"The base is not a readable GGUF file: {error}.", fix=fix) from error
    architecture = _read_field(reader, "general.architecture", str)
    if architecture not in PERMUTED_ARCHITECTURES | UNPERMUTED_ARCHITECTURES:
        known = ", ".join(sorted(PERMUTED_ARCHITECTURES | UNPERMUTED_ARCHITECTURES))
        raise ConfigurationError(
            "architecture of the base", got=architecture, allowed=known, fix="Serve it with `transformers:NAME`."
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
        problem = f"The field {key} of the base is {value!r}, not one {kind.__name__}."
        raise ConfigurationError.stating(problem, fix="Fetch the base again with `dualbrain models fetch`.")
    return value


def write_gguf_file(writer: Any) -> None:
    """Write all that was added to the `GGUFWriter` in the order of the format; the file is closed in any case."""
    try:
        writer.write_header_to_file()
        writer.write_kv_data_to_file()
        writer.write_tensors_to_file()
    finally:
        writer.close()
