"""Tensors in safetensors files that carry a checksum of their own: the format has none, and a flipped bit is read."""

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
"""The one entry beside the tensors: the library writes several in an order that chance decides."""


class TensorHeader(msgspec.Struct, frozen=True):
    """`facts` about the tensors, and the checksum of both."""

    sha256: str
    facts: dict[str, str]


class CorruptFileError(Exception):
    """A file that does not hold what was written."""


def encode_tensors(tensors: Mapping[str, Tensor], facts: Mapping[str, str]) -> bytes:
    """A file that holds `tensors`, and `facts` about them."""
    whole = {name: tensor.detach().contiguous().cpu() for name, tensor in tensors.items()}
    return save(whole, {HEADER_KEY: msgspec.json.encode(TensorHeader(checksum(whole, facts), dict(facts))).decode()})


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and facts of the file at `path`, as they were packed; raises `Damaged`.

    A file from before there were checksums is taken at its word.
    """
    try:
        with safe_open(path, "pt") as file:
            beside = dict(file.metadata() or {})
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        if HEADER_KEY not in beside:
            return tensors, beside
        label = msgspec.json.decode(beside[HEADER_KEY], type=TensorHeader)
    except (SafetensorError, *DECODE_ERRORS) as error:
        raise CorruptFileError(str(error)) from error
    if label.sha256 != checksum(tensors, label.facts):
        raise CorruptFileError("its checksum is that of another content")
    return tensors, label.facts


def checksum(tensors: Mapping[str, Tensor], facts: Mapping[str, str]) -> str:
    """SHA-256 over the facts, and over name, format, shape and bits of each tensor."""
    found = hashlib.sha256(repr(sorted(facts.items())).encode())
    for name, tensor in sorted(tensors.items()):
        found.update(repr((name, str(tensor.dtype), tuple(tensor.shape))).encode())
        found.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return found.hexdigest()
