"""The base in torch, made from the very GGUF that serves: what is adapted is what answers."""

# pyright: reportMissingImports=false

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from transformers import AutoModelForCausalLM, AutoTokenizer

from dualbrain.adaptation.bases import Base
from dualbrain.adaptation.fitting.dequantised import dequantised
from dualbrain.adaptation.fitting.quantised import quantise
from dualbrain.adaptation.serving.peft_lora import Pair, read_lora
from dualbrain.errors import InvalidSetup


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


@torch.no_grad()
def merge(model: Any, lora: dict[str, Pair]) -> None:
    """W ← W + BA for each layer that `lora` names (the scale stands in B already), in the numbers of the model."""
    for name, pair in lora.items():
        weight = model.get_submodule(name).weight
        weight += (torch.from_numpy(pair.b) @ torch.from_numpy(pair.a)).to(weight.dtype)
