"""Conversion of a peft LoRA adapter to GGUF-LoRA, checked against its base.

llama.cpp computes W x + (α/r) B A x with W as in the base's GGUF, so names, shapes and the order of rows must be those
of the base. For the architecture `llama` the rows of q and k are permuted from the two halves of each head to pairs;
rows of W are rows of B, so only B is permuted. A golden test verifies that llama.cpp computes the logits of torch.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dualbrain.adaptation.conversion.gguf_base import GgufBase, read_gguf_base, write_gguf_file
from dualbrain.adaptation.conversion.peft_lora import LoraPair, Matrix, read_lora
from dualbrain.core.storage.atomic_files import atomic_file
from dualbrain.errors import ConfigurationError

CONVERTER_VERSION = 1
"""To be increased when the conversion of an adapter gives another file than before."""


def convert_adapter(adapter: Path, base: Path, out: Path) -> int:
    """Convert the adapter in the folder `adapter` for the GGUF `base`; returns the number of layers written to `out`.

    Promise: `out` is complete or unchanged. Raises `ConfigurationError` for an adapter that llama.cpp would compute
    differently, `FileWriteError`.
    """
    return write_gguf_lora(read_lora(adapter), base, out)


def write_gguf_lora(pairs: dict[str, LoraPair], base: Path, out: Path) -> int:
    """As `convert_adapter`, from LoRA pairs that were read already."""
    facts = read_gguf_base(base)
    placed = map_to_base(pairs, facts)
    with atomic_file(out) as temporary:
        _write_tensors(placed, facts.architecture, temporary)
    return len(placed)


def map_to_base(pairs: dict[str, LoraPair], facts: GgufBase) -> dict[str, LoraPair]:
    """The pairs by tensor of the base, with rows in the base's order; raises `ConfigurationError`."""
    placed = {facts.find_tensor(module): _match_base(module, pair, facts) for module, pair in pairs.items()}
    if len(placed) != len(pairs):
        problem = "Two LoRA layers of the adapter belong to one tensor of the base."
        raise ConfigurationError.stating(problem, fix="This adapter cannot be served.")
    return placed


def permute_rows(rows: Matrix, heads: int) -> Matrix:
    """`rows` (n, …) of q or k, reordered from (head, half, i) to (head, i, half): rotary pairs become adjacent."""
    return rows.reshape(heads, 2, len(rows) // heads // 2, -1).swapaxes(1, 2).reshape(len(rows), -1)


def _match_base(module: str, pair: LoraPair, facts: GgufBase) -> LoraPair:
    """`pair` with rows in the base's order; raises `ConfigurationError` if its size is not that of the base."""
    tensor = facts.find_tensor(module)
    if (pair.a.shape[1], pair.b.shape[0]) != facts.shapes[tensor]:
        shape = facts.shapes[tensor]
        problem = (
            f"The LoRA of {module}, A {pair.a.shape} and B {pair.b.shape}, does not fit its layer (in, out = {shape})."
        )
        raise ConfigurationError.stating(problem, fix="It was made for another base.")
    layer = tensor.split(".")[2]
    if not facts.is_permuted or layer not in ("attn_q", "attn_k"):
        return pair
    return LoraPair(pair.a, permute_rows(pair.b, facts.heads if layer == "attn_q" else facts.kv_heads))


def _write_tensors(placed: dict[str, LoraPair], architecture: str, path: Path) -> None:
    """Write the pairs with α = 1 and r B in place of B, so that α/r of llama.cpp restores B for any rank r."""
    import gguf  # noqa: PLC0415  (only where an adapter is served)

    writer: Any = gguf.GGUFWriter(path, architecture)
    writer.add_type("adapter")
    writer.add_string("adapter.type", "lora")
    writer.add_float32("adapter.lora.alpha", 1.0)
    for tensor, pair in sorted(placed.items()):
        rank = np.float32(len(pair.a))
        writer.add_tensor(f"{tensor}.lora_a", np.ascontiguousarray(pair.a, np.float32))
        writer.add_tensor(f"{tensor}.lora_b", np.ascontiguousarray(pair.b * rank, np.float32))
    write_gguf_file(writer)
