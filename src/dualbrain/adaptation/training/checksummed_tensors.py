"""Tensors in safetensors files with a checksum: the format has none, and would read a flipped bit without an error."""

# pyright: reportMissingImports=false

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

import msgspec
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from dualbrain.errors import DECODE_ERRORS

HEADER_KEY = "label"
"""The only metadata entry beside the tensors: the library writes several entries in random order."""


class TensorHeader(msgspec.Struct, frozen=True):
    """`facts` about the tensors, and the checksum of both."""

    sha256: str
    facts: dict[str, str]


class CorruptFileError(Exception):
    """A file with another content than was written."""


def encode_tensors(tensors: Mapping[str, Tensor], facts: Mapping[str, str]) -> bytes:
    """The bytes of a file with `tensors` and `facts` about them."""
    on_cpu = {name: tensor.detach().contiguous().cpu() for name, tensor in tensors.items()}
    return save(on_cpu, {HEADER_KEY: msgspec.json.encode(TensorHeader(checksum(on_cpu, facts), dict(facts))).decode()})


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and facts of the file at `path`; raises `CorruptFileError`.

    A file of an older version has no checksum and is not checked.
    """
    try:
        with safe_open(path, "pt") as file:
            metadata = dict(file.metadata() or {})
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        if HEADER_KEY not in metadata:
            return tensors, metadata
        header = msgspec.json.decode(metadata[HEADER_KEY], type=TensorHeader)
    except (SafetensorError, *DECODE_ERRORS) as error:
        raise CorruptFileError(str(error)) from error
    if header.sha256 != checksum(tensors, header.facts):
        raise CorruptFileError("its checksum does not match its content")
    return tensors, header.facts


def checksum(tensors: Mapping[str, Tensor], facts: Mapping[str, str]) -> str:
    """SHA-256 over the facts, and over name, format, shape and bits of each tensor."""
    digest = hashlib.sha256(repr(sorted(facts.items())).encode())
    for name, tensor in sorted(tensors.items()):
        digest.update(repr((name, str(tensor.dtype), tuple(tensor.shape))).encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()
