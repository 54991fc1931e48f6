"""The base in torch, made from the very GGUF that serves: what is adapted is what answers."""

# pyright: reportMissingImports=false

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Any

import torch
from transformers import AutoModelForCausalLM, AutoTokenizer
from transformers.utils import logging

from dualbrain.adaptation.bases import Base
from dualbrain.adaptation.durable import DiskFull, sync_folder
from dualbrain.adaptation.fitting.quantised import quantise
from dualbrain.adaptation.serving.peft_lora import Pair, read_lora
from dualbrain.errors import InvalidSetup, MissingPart


def open_base(base: Base, cache: Path, dtype: Any, device: Any = "cpu", *, nf4: bool = False) -> tuple[Any, Any]:
    """Model and tokenizer of `base`, with what it wears merged into its weights; no network, no code from files.

    In float32 the weights are exactly those that serve (see `dequantised`). `dtype` bf16 rounds each by at most 2^-9 of
    itself, and `nf4` quantises its linear layers once more (see `quantise`). llama.cpp also rounds activations to 8
    bits, which torch does not: gate and canary run where it serves.
    """
    folder = dequantised(base, cache)
    tokenizer = AutoTokenizer.from_pretrained(folder, local_files_only=True)
    model = AutoModelForCausalLM.from_pretrained(
        folder, dtype=torch.float32, attn_implementation="sdpa", local_files_only=True, use_safetensors=True
    )  # fused attention: 0.9 of the eager's time a step at some 340 tokens
    if tokenizer.chat_template is None:
        raise InvalidSetup(
            "base", got=f"{base.gguf.name}, without a chat template", allowed="an instruction-tuned model"
        )
    for worn in base.wears:
        merge(model, read_lora(worn))
    for parameter in model.parameters():  # not the buffers: rotary frequencies stay float32
        parameter.data = parameter.data.to(dtype)
    if nf4:
        quantise(model, device)
    return model.to(device).eval().requires_grad_(False), tokenizer


def dequantised(base: Base, cache: Path) -> Path:
    """The folder in `cache` that holds `base` without what it wears, in float32; made the first time, 4 bytes a number.

    Block scales times quanta, as llama.cpp does it.
    """
    logging.disable_progress_bar()  # our own progress is told line by line
    folder = cache / "torch" / base.gguf_sha256[:32]
    if not folder.is_dir():
        _dequantise(base.gguf, folder)
    return folder


@torch.no_grad()
def merge(model: Any, lora: dict[str, Pair]) -> None:
    """W ← W + BA for each layer that `lora` names (the scale stands in B already), in the numbers of the model."""
    for name, pair in lora.items():
        weight = model.get_submodule(name).weight
        weight += (torch.from_numpy(pair.b) @ torch.from_numpy(pair.a)).to(weight.dtype)


def _dequantise(gguf: Path, folder: Path) -> None:
    """Write the model as safetensors with its tokenizer, whole or not at all."""
    if not gguf.is_file():
        raise MissingPart(f"The model file {gguf.name!r}", fix=f"Get it with `dualbrain models fetch`. {gguf}")
    folder.parent.mkdir(parents=True, exist_ok=True)
    beside = Path(tempfile.mkdtemp(dir=folder.parent, prefix=".dequantised-"))
    try:
        packed = AutoModelForCausalLM.from_pretrained(gguf.parent, gguf_file=gguf.name, dtype=torch.float32)
        told = {k: v for k, v in packed.config.to_dict().items() if k not in ("quantization_config", "_name_or_path")}
        plain = type(packed)(type(packed.config)(**told))
        plain.load_state_dict(packed.state_dict(), strict=False)
        plain.tie_weights()
        plain.save_pretrained(beside, safe_serialization=True)
        AutoTokenizer.from_pretrained(gguf.parent, gguf_file=gguf.name).save_pretrained(beside)
        _settle(beside, folder)
        sync_folder(folder.parent)
    except OSError as error:
        raise DiskFull(folder, error.strerror or str(error)) from error
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def _settle(beside: Path, folder: Path) -> None:
    """Give `beside` its name, unless another process was quicker: it made the same."""
    try:
        beside.rename(folder)
    except OSError:
        if not folder.is_dir():
            raise
