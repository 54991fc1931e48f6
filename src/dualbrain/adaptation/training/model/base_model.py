"""The base model in torch, made from the GGUF file that serves, so that training and serving use the same weights."""

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
    """Model and tokenizer of `base`, with its stacked adapters merged into the weights.

    No network is used and no code from files is run. In float32 the weights are exactly those that serve (see
    `dequantize_base`). With `dtype` bf16 each weight is rounded by at most 2^-9 of its value, and `nf4` quantises the
    linear layers again (see `quantize_linear_layers`). llama.cpp also rounds activations to 8 bits, which torch does
    not: promotion and canaries use the serving runtime. Raises `ConfigurationError` for a base without chat template or
    an adapter that does not match, `MissingDependencyError`.
    """
    folder = dequantize_base(base, cache)
    tokenizer = AutoTokenizer.from_pretrained(folder, local_files_only=True)
    model = AutoModelForCausalLM.from_pretrained(
        folder, dtype=torch.float32, attn_implementation="sdpa", local_files_only=True, use_safetensors=True
    )  # fused attention takes 0.9 of the time of eager attention per step at about 340 tokens
    if tokenizer.chat_template is None:
        problem = f"The base {base.gguf.name} has no chat template."
        raise ConfigurationError.stating(problem, fix="Choose an instruction-tuned model.")
    for adapter in base.stacked_on:
        merge_lora(model, read_lora(adapter))
    for parameter in model.parameters():  # not the buffers: rotary frequencies stay float32
        parameter.data = parameter.data.to(dtype)
    if nf4:
        quantize_linear_layers(model, device)
    return model.to(device).eval().requires_grad_(False), tokenizer


@torch.no_grad()
def merge_lora(model: Any, lora: dict[str, LoraPair]) -> None:
    """W ← W + BA for each layer of `lora` (B includes the scaling), in the number format of the model.

    Raises `ConfigurationError` before any weight is changed for a layer that the model lacks or that has another size,
    as the converter for llama.cpp does.
    """
    modules = dict(model.named_modules())
    weights = {name: _find_linear(name, modules, model.get_output_embeddings()).weight for name in lora}
    for name, pair in lora.items():
        if weights[name].shape != (len(pair.b), pair.a.shape[1]):
            shape = tuple(weights[name].shape)
            sizes = f"A {pair.a.shape} and B {pair.b.shape}"
            problem = f"The LoRA of {name}, {sizes}, does not fit its layer (out, in = {shape})."
            raise ConfigurationError.stating(problem, fix="It was made for another base.")
    for name, pair in lora.items():
        weights[name] += (torch.from_numpy(pair.b) @ torch.from_numpy(pair.a)).to(weights[name].dtype)


def _find_linear(name: str, modules: dict[str, Any], head: Any) -> torch.nn.Linear:
    """The linear layer called `name`; embeddings and the output matrix `head` cannot be adapted."""
    found = modules.get(name)
    if not isinstance(found, torch.nn.Linear) or found is head:
        raise ConfigurationError("LoRA layer", got=name, allowed="a linear layer of this base's blocks")
    return found
