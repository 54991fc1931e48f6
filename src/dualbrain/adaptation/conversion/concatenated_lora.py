"""Concatenation of several adapters on one base: B₁A₁ + B₂A₂ = [B₁ B₂][A₁; A₂], exact, at the sum of their ranks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from dualbrain.adaptation.conversion.peft_lora import CONFIG_FILE, WEIGHTS_FILE, LoraPair, read_lora


def concatenate_adapters(folders: list[Path]) -> dict[str, LoraPair]:
    """The LoRA pairs of all adapters in `folders`, joined layer by layer."""
    joined: dict[str, LoraPair] = {}
    for folder in folders:
        for module, pair in read_lora(folder).items():
            other = joined.get(module)
            joined[module] = (
                pair
                if other is None
                else LoraPair(np.concatenate((other.a, pair.a)), np.concatenate((other.b, pair.b), axis=1))
            )
    return joined


def write_peft_adapter(pairs: dict[str, LoraPair], folder: Path, *, base: str) -> None:
    """Write `pairs` to `folder` in the format of peft and vLLM: float32, with α = r so that the scaling is 1.

    The files are written one after the other: for a folder that is complete or absent, write to one of `atomic_folder`.
    """
    from safetensors.numpy import save  # noqa: PLC0415  (only where an adapter is exported)

    folder.mkdir(parents=True, exist_ok=True)
    ranks = {module: len(pair.a) for module, pair in pairs.items()}
    most = max(ranks.values())
    other_ranks = {module: rank for module, rank in ranks.items() if rank != most}
    config: dict[str, Any] = {
        "peft_type": "LORA",
        "task_type": "CAUSAL_LM",
        "base_model_name_or_path": base,
        "inference_mode": True,
        "r": most,
        "lora_alpha": most,
        "rank_pattern": other_ranks,
        "alpha_pattern": other_ranks,
        "lora_dropout": 0.0,
        "bias": "none",
        "use_dora": False,
        "use_rslora": False,
        "fan_in_fan_out": False,
        "modules_to_save": None,
        "target_modules": sorted({module.rpartition(".")[2] for module in pairs}),
    }
    tensors = {
        f"base_model.model.{module}.lora_{half}.weight": np.ascontiguousarray(matrix, np.float32)
        for module, pair in pairs.items()
        for half, matrix in (("A", pair.a), ("B", pair.b))
    }
    (folder / WEIGHTS_FILE).write_bytes(save(tensors, {"format": "pt"}))
    (folder / CONFIG_FILE).write_text(json.dumps(config, indent=2, sort_keys=True))
