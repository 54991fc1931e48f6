"""An adapter merged into its base, as one GGUF in half precision, for programs that cannot load adapters.

The matrices are W + BA in float16. They are not quantised to the base's 4 bits: the change is a few per cent of a
quantisation step, so rounding would remove the adapter without any error.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dualbrain.adaptation.conversion.gguf_base import read_gguf_base, write_gguf_file
from dualbrain.adaptation.conversion.gguf_lora import map_to_base
from dualbrain.adaptation.conversion.peft_lora import LoraPair
from dualbrain.core.storage.atomic_files import atomic_file

WRITER_KEYS = ("GGUF.version", "GGUF.tensor_count", "GGUF.kv_count", "general.architecture", "general.file_type")
"""Keys that the writer adds by itself."""


def write_merged_gguf(pairs: dict[str, LoraPair], base: Path, out: Path) -> None:
    """Write `base` with `pairs` merged to `out`, all matrices in float16.

    Raises `ConfigurationError` if `pairs` do not match the base, `FileWriteError`.
    """
    facts = read_gguf_base(base)
    placed = map_to_base(pairs, facts)
    with atomic_file(out) as temporary:
        _write_tensors(placed, base, facts.architecture, temporary)


def _write_tensors(placed: dict[str, LoraPair], base: Path, architecture: str, path: Path) -> None:
    import gguf  # noqa: PLC0415  (only where an adapter is exported)

    reader, writer = gguf.GGUFReader(base), gguf.GGUFWriter(path, architecture)
    writer.add_file_type(gguf.LlamaFileType.MOSTLY_F16)
    for key, field in reader.fields.items():
        if key not in WRITER_KEYS:
            _copy_field(writer, key, field)
    for tensor in reader.tensors:
        weights = gguf.quants.dequantize(tensor.data, tensor.tensor_type)
        if tensor.name in placed:
            weights = weights + placed[tensor.name].b @ placed[tensor.name].a
        writer.add_tensor(tensor.name, weights.astype(np.float16 if weights.ndim > 1 else np.float32))
    write_gguf_file(writer)


def _copy_field(writer: Any, key: str, field: Any) -> None:
    kind, inner = field.types[0], field.types[-1] if len(field.types) > 1 else None
    writer.add_key_value(key, field.contents(), kind, sub_type=inner)
