"""The base in torch, made from the very GGUF that serves: what is adapted is what answers."""

# pyright: reportMissingImports=false

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from transformers import AutoModelForCausalLM, AutoTokenizer

from dualbrain.adaptation.adapters.base_models import BaseModel
from dualbrain.adaptation.conversion.peft_lora import LoraPair, read_lora
from dualbrain.adaptation.training.model.dequantized_base import dequantize_base
from dualbrain.adaptation.training.model.quantized_layers import quantize_linear_layers
from dualbrain.errors import ConfigurationError


def load_base_model(
    base: BaseModel, cache: Path, dtype: Any, device: Any = "cpu", *, nf4: bool = False
) -> tuple[Any, Any]:
    """Model and tokenizer of `base`, with what it wears merged into its weights; no network, no code from files.

    In float32 the weights are exactly those that serve (see `dequantised`). `dtype` bf16 rounds each by at most 2^-9 of
    itself, and `nf4` quantises its linear layers once more (see `quantise`). llama.cpp also rounds activations to 8
    bits, which torch does not: gate and canary run where it serves.
    """
    folder = dequantize_base(base, cache)
    tokenizer = AutoTokenizer.from_pretrained(folder, local_files_only=True)
    model = AutoModelForCausalLM.from_pretrained(
        folder, dtype=torch.float32, attn_implementation="sdpa", local_files_only=True, use_safetensors=True
    )  # fused attention: 0.9 of the eager's time a step at some 340 tokens
    if tokenizer.chat_template is None:
        raise ConfigurationError(
            "base", got=f"{base.gguf.name}, without a chat template", allowed="an instruction-tuned model"
        )
    for worn in base.stacked_on:
        merge_lora(model, read_lora(worn))
    for parameter in model.parameters():  # not the buffers: rotary frequencies stay float32
        parameter.data = parameter.data.to(dtype)
    if nf4:
        quantize_linear_layers(model, device)
    return model.to(device).eval().requires_grad_(False), tokenizer


@torch.no_grad()
def merge_lora(model: Any, lora: dict[str, LoraPair]) -> None:
    """W ← W + BA for each layer that `lora` names (the scale stands in B already), in the numbers of the model.

    Raises `InvalidSetup` before any weight is changed, as the converter for llama.cpp does, for a pair that has no
    place in the model or another size than its layer.
    """
    modules = dict(model.named_modules())
    weights = {name: _find_linear(name, modules, model.get_output_embeddings()).weight for name in lora}
    for name, pair in lora.items():
        if weights[name].shape != (len(pair.b), pair.a.shape[1]):
            got, allowed = f"A {pair.a.shape}, B {pair.b.shape}", f"out, in = {tuple(weights[name].shape)}"
            raise ConfigurationError(f"LoRA of {name}", got=got, allowed=allowed, fix="It was made for another base.")
    for name, pair in lora.items():
        weights[name] += (torch.from_numpy(pair.b) @ torch.from_numpy(pair.a)).to(weights[name].dtype)


def _find_linear(name: str, modules: dict[str, Any], head: Any) -> torch.nn.Linear:
    """The linear layer called `name`; embeddings and the output matrix `head` are none that is adapted."""
    found = modules.get(name)
    if not isinstance(found, torch.nn.Linear) or found is head:
        raise ConfigurationError("LoRA layer", got=name, allowed="a linear layer of this base's blocks")
    return found
