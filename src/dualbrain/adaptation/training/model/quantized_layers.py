"""QLoRA's base (Dettmers et al. 2023): frozen layers in 4 bits, dequantised where they multiply."""

# pyright: reportMissingImports=false

from __future__ import annotations

from importlib import import_module
from typing import Any

import torch

from dualbrain.errors import ConfigurationError, MissingDependencyError

BLOCK_SIZE = 64
"""Weights that share a scale."""


def quantize_linear_layers(model: Any, device: Any) -> None:
    """Put every linear layer of `model` but the output matrix into NF4 on `device`; computed in their former format.

    Each `BLOCK` of weights has a scale, itself in 8 bits (double quantisation): 4.13 bits a weight. What it wears must
    have been merged before. Raises `MissingPart` without bitsandbytes, and `InvalidSetup` for a base whose rows are not
    whole blocks: bitsandbytes 0.50 unpacks those wrongly on processors, without a word.
    """
    layers, head = _import_bitsandbytes().nn, model.get_output_embeddings()
    for name, layer in list(model.named_modules()):
        if isinstance(layer, torch.nn.Linear) and layer is not head:
            model.set_submodule(name, _to_4bit_layer(layers, layer).to(device))
    model.is_loaded_in_4bit = True  # peft asks the model, not the layer


def _to_4bit_layer(layers: Any, layer: torch.nn.Linear) -> Any:
    """`layer` as one that is packed when it is moved to its device."""
    if layer.in_features % BLOCK_SIZE:
        fix = 'Set `[fit] quantise = "none"`.'
        raise ConfigurationError(
            "row of the base in nf4", got=layer.in_features, allowed=f"multiples of {BLOCK_SIZE}", fix=fix
        )
    made = layers.Linear4bit(
        layer.in_features, layer.out_features, bias=False, compute_dtype=layer.weight.dtype, device="meta"
    )
    made.weight = layers.Params4bit(
        layer.weight.data,
        requires_grad=False,
        quant_type="nf4",
        blocksize=BLOCK_SIZE,
        compress_statistics=True,
        module=made,
    )
    made.bias = layer.bias
    made.support_avx512bf16_for_cpu = False  # that way packs anew when evaluated, and then has no gradient
    return made


def _import_bitsandbytes() -> Any:
    try:
        return import_module("bitsandbytes")
    except ModuleNotFoundError as error:
        fix = "Install it with `pip install 'dualbrain[qlora]'`."
        raise MissingDependencyError("bitsandbytes, of the extra `qlora`,", fix=fix) from error
