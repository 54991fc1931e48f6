"""Reader for a LoRA adapter in peft's format, without torch; everything other than plain LoRA is rejected.

h ← W x + s B A x with A (r, in), B (out, r) and s = α/r, or α/√r if rank-stabilised (Hu et al. 2022, Kalajdzievski
2023). Ignoring an unknown setting would serve another model than the measured one.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.untrusted.bounded_file import read_bounded_file
from dualbrain.errors import ConfigurationError, MissingDependencyError

MAX_CONFIG_BYTES, MAX_WEIGHTS_BYTES = 16 << 20, 4 << 30
"""Largest sizes of the configuration and of the weights of an adapter."""

WEIGHTS_FILE, CONFIG_FILE = "adapter_model.safetensors", "adapter_config.json"
TENSOR_NAME = re.compile(r"base_model\.model\.(.+)\.lora_([AB])\.weight")
LAYER_NAME_PATTERN = re.compile(r"\^?[A-Za-z0-9_.]+")
"""Accepted key of peft's patterns: the name of a layer, with an optional ^ as in peft's examples. Other regular
expressions are rejected because they may take unbounded time."""
KNOWN_SETTINGS = frozenset(
    {
        "peft_type",
        "r",
        "lora_alpha",
        "use_rslora",
        "rank_pattern",
        "alpha_pattern",
        "target_modules",
        "task_type",
        "base_model_name_or_path",
        "revision",
        "peft_version",
        "auto_mapping",
        "inference_mode",
        "lora_dropout",
        "megatron_core",
        "qalora_group_size",
    }
)
"""Settings of peft that are read here or do not affect the computation."""
PLAIN_VALUES: dict[str, tuple[Any, ...]] = {"bias": ("none",), "init_lora_weights": (True, False, "gaussian")}
"""Accepted values of two further settings. Every other setting, known or unknown, must be off: it may affect the
computation."""

Matrix = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class LoraPair:
    """A (r, in) and B (out, r) of one linear layer; B includes the scaling s."""

    a: Matrix
    b: Matrix


def read_lora(folder: Path) -> dict[str, LoraPair]:
    """The pairs of the adapter in `folder` by layer name, such as `model.layers.0.self_attn.q_proj`.

    Raises `ConfigurationError` for a file that cannot be read and for everything other than plain LoRA: DoRA, biases,
    whole modules, a subset of layers, unknown settings, patterns that are not names, other tensor names, incomplete
    pairs, ranks other than the config's, numbers that are not finite. Raises `MissingDependencyError` for a missing
    file or package.
    """
    config = _read_config(folder)
    halves: dict[str, dict[str, Matrix]] = {}
    for name, tensor in _read_tensors(folder / WEIGHTS_FILE):
        found = TENSOR_NAME.fullmatch(name)
        if found is None:
            raise _unsupported("tensor", name, "a LoRA matrix A or B of a linear layer")
        halves.setdefault(found[1], {})[found[2]] = tensor
    if not halves:
        raise _unsupported("adapter", "no tensors", "at least one pair of A and B")
    return {module: _build_pair(module, both, config) for module, both in sorted(halves.items())}


def _read_config(folder: Path) -> dict[str, Any]:
    path = folder / CONFIG_FILE
    if not path.is_file():
        raise MissingDependencyError(
            f"{CONFIG_FILE} of the adapter", fix=f"Name a folder that was written by peft. {folder}"
        )
    try:
        config = json.loads(read_bounded_file(path, MAX_CONFIG_BYTES))
    except (ValueError, RecursionError) as error:
        raise _unsupported(CONFIG_FILE, str(error), "JSON as peft writes it") from error
    if not isinstance(config, dict) or config.get("peft_type") != "LORA":
        raise _unsupported("peft_type", config.get("peft_type") if isinstance(config, dict) else config, "LORA")
    require_plain_lora(config)
    return config


def require_plain_lora(config: dict[str, Any]) -> None:
    """Raise `ConfigurationError` for a setting in peft's config that makes the layer more than h + s B A x."""
    for setting, value in config.items():
        if setting in PLAIN_VALUES and value not in PLAIN_VALUES[setting]:
            allowed = " or ".join(json.dumps(one) for one in PLAIN_VALUES[setting])
            raise _unsupported(setting, value, f"plain LoRA only, with {allowed}")
        if setting not in PLAIN_VALUES and setting not in KNOWN_SETTINGS and not _is_off(value):
            raise _unsupported(setting, value, "plain LoRA only, without it")


def _is_off(value: object) -> bool:
    """Whether a setting is off; the number 0 is not, because it may denote a layer."""
    return value is None or value is False or value in ("", [], {})


def _read_tensors(path: Path) -> list[tuple[str, Matrix]]:
    try:
        from safetensors import SafetensorError, deserialize  # noqa: PLC0415  (only where an adapter is served)
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            "The package safetensors", fix="Install it with `pip install 'dualbrain[planner]'`."
        ) from error
    if not path.is_file():
        raise MissingDependencyError(
            f"{WEIGHTS_FILE} of the adapter", fix=f"Name a folder that was written by peft. {path.parent}"
        )
    try:
        return [
            (name, _decode_matrix(name, tensor))
            for name, tensor in deserialize(read_bounded_file(path, MAX_WEIGHTS_BYTES))
        ]
    except SafetensorError as error:
        raise _unsupported(WEIGHTS_FILE, str(error), "a whole safetensors file") from error


def _decode_matrix(name: str, tensor: Any) -> Matrix:
    """The float32 numbers of one tensor; bf16 is the upper half of float32."""
    data, kind = tensor["data"], tensor["dtype"]
    match kind:
        case "F32":
            flat = np.frombuffer(data, "<f4")
        case "F16":
            flat = np.frombuffer(data, "<f2").astype(np.float32)
        case "BF16":
            flat = (np.frombuffer(data, "<u2").astype(np.uint32) << 16).view(np.float32)
        case _:
            raise _unsupported(f"number format of {name}", kind, "F32, F16 or BF16")
    matrix = flat.reshape(tensor["shape"])
    if matrix.ndim != 2 or not np.isfinite(matrix).all():
        raise _unsupported(f"tensor {name}", tensor["shape"], "a matrix of finite numbers")
    return matrix


def _build_pair(module: str, both: dict[str, Matrix], config: dict[str, Any]) -> LoraPair:
    if set(both) != {"A", "B"}:
        raise _unsupported(f"adapter of {module}", f"only {', '.join(both)}", "A and B")
    a, b = both["A"], both["B"]
    rank = _require_positive("rank", _match_pattern(config.get("rank_pattern"), module, config.get("r")))
    alpha = _require_positive("alpha", _match_pattern(config.get("alpha_pattern"), module, config.get("lora_alpha")))
    if not a.shape[0] == b.shape[1] == rank:
        raise _unsupported(f"rank of {module}", (a.shape, b.shape), f"A ({rank}, in), B (out, {rank})")
    scaling = alpha / (math.sqrt(rank) if config.get("use_rslora") else rank)
    with np.errstate(over="ignore"):
        scaled = np.asarray(b * np.float32(scaling), np.float32)
        is_finite = np.isfinite(scaled * np.float32(rank)).all()  # as stored in GGUF
    if not is_finite:
        raise _unsupported(f"alpha of {module}", alpha, "one with which B is finite")
    return LoraPair(a, scaled)


def _require_positive(name: str, value: Any) -> float:
    """`value` if it is a finite number above 0; Python's JSON reader also accepts NaN and Infinity."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value < math.inf:
        raise _unsupported(name, value, "a finite number above 0")
    return value


def _match_pattern(pattern: Any, module: str, default: Any) -> Any:
    """The value for `module`: that of the first pattern its name ends in. As in peft, a dot matches any character."""
    if not isinstance(pattern, dict | None):
        raise _unsupported("pattern", pattern, "values by layer")
    for key in pattern or {}:
        if LAYER_NAME_PATTERN.fullmatch(key) is None:
            raise _unsupported("pattern", key, "names of layers: letters, digits, dots, underscores")
    return next((value for key, value in (pattern or {}).items() if re.match(rf"(.*\.)?({key})$", module)), default)


def _unsupported(what: str, got: object, allowed: str) -> ConfigurationError:
    return ConfigurationError(f"LoRA {what}", got=got, allowed=allowed, fix="This adapter cannot be served.")
