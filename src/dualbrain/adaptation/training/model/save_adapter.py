"""Writing an adapter in the format of peft and vLLM: safetensors and a config that identifies the base by hash."""

# pyright: reportMissingImports=false

from __future__ import annotations

import json
from pathlib import Path

import torch
from safetensors.torch import save

from dualbrain.adaptation.training.model.lora_model import LoraModel
from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.core.storage.private_files import create_private_folder

WEIGHTS_FILE, CONFIG_FILE = "adapter_model.safetensors", "adapter_config.json"


def save_adapter(lora_model: LoraModel, folder: Path, *, base: str) -> None:
    """Write the adapter of `lora_model`; `base` is the hash of the base's weights. Raises `FileWriteError`.

    The file is in bf16 for every compute format: half the size, and each number is off by at most 2^-9 of its
    value.
    """
    create_private_folder(folder)
    config = lora_model.model.peft_config["default"].to_dict() | {
        "base_model_name_or_path": base,
        "inference_mode": True,
    }
    rounded = {name: tensor.to(torch.bfloat16) for name, tensor in lora_model.adapter_tensors().items()}
    write_atomically(folder / WEIGHTS_FILE, save(rounded, {"base": base}))
    write_atomically(folder / CONFIG_FILE, json.dumps(config, indent=2, sort_keys=True, default=_to_json).encode())


def _to_json(value: object) -> object:
    return sorted(value) if isinstance(value, set | frozenset) else str(value)
