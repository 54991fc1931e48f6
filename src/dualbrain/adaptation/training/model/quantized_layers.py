"""The quantised base of QLoRA (Dettmers et al. 2023): frozen layers in 4 bits, dequantised for each multiplication."""

# pyright: reportMissingImports=false

from __future__ import annotations

from importlib import import_module
from typing import Any

import torch

from dualbrain.errors import ConfigurationError, MissingDependencyError

BLOCK_SIZE = 64
"""Number of weights that share a scale."""


def quantize_linear_layers(model: Any, device: Any) -> None:
    """Convert every linear layer of `model` except the output matrix to NF4 on `device`; the compute format stays.

    Each block of `BLOCK_SIZE` weights has a scale in 8 bits (double quantisation): 4.13 bits per weight. Stacked
    adapters must be merged before. Raises `MissingDependencyError` without bitsandbytes, and `ConfigurationError` for
    rows that are not a multiple of the block size: bitsandbytes 0.50 unpacks these incorrectly on CPUs, without an
    error.
    """
    layers, head = _import_bitsandbytes().nn, model.get_output_embeddings()
    for name, layer in list(model.named_modules()):
        if isinstance(layer, torch.nn.Linear) and layer is not head:
            model.set_submodule(name, _to_4bit_layer(layers, layer).to(device))
    model.is_loaded_in_4bit = True  # peft asks the model, not the layer


def _to_4bit_layer(layers: Any, layer: torch.nn.Linear) -> Any:
    """`layer` as a 4-bit layer, which is packed when it is moved to its device."""
    if layer.in_features % BLOCK_SIZE:
        fix = 'Set `[fit] quantise = "none"`.'
        raise ConfigurationError(
            "row of the base in nf4", got=layer.in_features, allowed=f"multiples of {BLOCK_SIZE}", fix=fix
        )
    quantized = layers.Linear4bit(
        layer.in_features, layer.out_features, bias=False, compute_dtype=layer.weight.dtype, device="meta"
    )
    quantized.weight = layers.Params4bit(
        layer.weight.data,
        requires_grad=False,
        quant_type="nf4",
        blocksize=BLOCK_SIZE,
        compress_statistics=True,
        module=quantized,
    )
    quantized.bias = layer.bias
    quantized.support_avx512bf16_for_cpu = False  # that code path packs again in evaluation and loses the gradient
    return quantized


def _import_bitsandbytes() -> Any:
    try:
        return import_module("bitsandbytes")
    except ModuleNotFoundError as error:
        fix = "Install it with `pip install 'dualbrain[qlora]'`."
        raise MissingDependencyError("The package bitsandbytes of the extra `qlora`", fix=fix) from error
