"""An adapter as peft and vLLM load it: safetensors and its config, the base named by hash."""

# pyright: reportMissingImports=false

from __future__ import annotations

import json
from pathlib import Path

import torch
from safetensors.torch import save

from dualbrain.adaptation.training.model.lora_model import Learner
from dualbrain.core.storage.atomic_files import write_durably

WEIGHTS, CONFIG = "adapter_model.safetensors", "adapter_config.json"


def write_adapter(learner: Learner, folder: Path, *, base: str) -> None:
    """Write the adapter that `learner` wears; `base` names the weights it was fitted on. Raises `DiskFull`.

    In bf16, whatever it was computed in: half the size, and each number off by at most 2^-9 of itself.
    """
    folder.mkdir(parents=True, exist_ok=True)
    shape = learner.model.peft_config["default"].to_dict() | {"base_model_name_or_path": base, "inference_mode": True}
    rounded = {name: tensor.to(torch.bfloat16) for name, tensor in learner.adapter().items()}
    write_durably(folder / WEIGHTS, save(rounded, {"base": base}))
    write_durably(folder / CONFIG, json.dumps(shape, indent=2, sort_keys=True, default=_plain).encode())


def _plain(value: object) -> object:
    return sorted(value) if isinstance(value, set | frozenset) else str(value)
