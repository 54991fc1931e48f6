"""From peft's LoRA to GGUF-LoRA, checked against the very base it will sit on.

llama.cpp computes W x + (α/r) B A x with W as the base's GGUF has it, so names, shapes and the order of rows must be
the base's. For the architecture `llama` the rows of q and k are permuted from the two halves of each head to pairs;
rows of W are rows of B, so only B moves. Guarded by a golden test: torch's logits are llama.cpp's.
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
"""Rises when the same adapter would become another file."""


def convert_adapter(adapter: Path, base: Path, out: Path) -> int:
    """Write the adapter in the folder `adapter` for the GGUF `base` to `out`; returns how many layers it touches.

    Promise: `out` is whole or as it was before. Raises `InvalidSetup` for what cannot be served alike, `DiskFull`.
    """
    return write_gguf_lora(read_lora(adapter), base, out)


def write_gguf_lora(pairs: dict[str, LoraPair], base: Path, out: Path) -> int:
    """As `convert`, from pairs that were read already."""
    facts = read_gguf_base(base)
    placed = map_to_base(pairs, facts)
    with atomic_file(out) as beside:
        _write_tensors(placed, facts.architecture, beside)
    return len(placed)


def map_to_base(pairs: dict[str, LoraPair], facts: GgufBase) -> dict[str, LoraPair]:
    """The pairs by the base's tensor that each sits on, rows in the base's order; raises `InvalidSetup`."""
    placed = {facts.find_tensor(module): _match_base(module, pair, facts) for module, pair in pairs.items()}
    if len(placed) != len(pairs):
        raise ConfigurationError("LoRA layers", got="two for one tensor of the base", allowed="one each")
    return placed


def permute_rows(rows: Matrix, heads: int) -> Matrix:
    """`rows` (n, …) of q or k from (head, half, i) to (head, i, half): rotary pairs side by side."""
    return rows.reshape(heads, 2, len(rows) // heads // 2, -1).swapaxes(1, 2).reshape(len(rows), -1)


def _match_base(module: str, pair: LoraPair, facts: GgufBase) -> LoraPair:
    """`pair` in the base's order of rows; raises `InvalidSetup` if it is not of the base's size."""
    place = facts.find_tensor(module)
    if (pair.a.shape[1], pair.b.shape[0]) != facts.shapes[place]:
        got, allowed = f"A {pair.a.shape}, B {pair.b.shape}", f"in, out = {facts.shapes[place]}"
        raise ConfigurationError(f"LoRA of {module}", got=got, allowed=allowed, fix="It was made for another base.")
    layer = place.split(".")[2]
    if not facts.is_permuted or layer not in ("attn_q", "attn_k"):
        return pair
    return LoraPair(pair.a, permute_rows(pair.b, facts.heads if layer == "attn_q" else facts.kv_heads))


def _write_tensors(placed: dict[str, LoraPair], architecture: str, path: Path) -> None:
    """α is 1 and B is multiplied by r, so that llama.cpp's α/r leaves the B that was given, whatever r a layer has."""
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
