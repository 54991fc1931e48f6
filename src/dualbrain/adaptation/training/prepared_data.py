"""A data set prepared for one model: tokens, sample weights ω̃, and the states of the reference model."""

# pyright: reportMissingImports=false

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualbrain.adaptation.config import ObjectiveConfig
from dualbrain.adaptation.curation.dataset import Dataset
from dualbrain.adaptation.training.model.batching import EncodedSample, encode_sample
from dualbrain.adaptation.training.model.lora_model import LoraModel
from dualbrain.adaptation.training.objective import normalize_weights, sample_weights
from dualbrain.adaptation.training.process_group import SINGLE_PROCESS, ProcessGroup
from dualbrain.adaptation.training.reference_states import (
    ReferenceStates,
    compute_states,
    load_states,
    save_states,
    states_key,
)
from dualbrain.errors import ConfigurationError


@dataclass(frozen=True, slots=True, kw_only=True)
class PreparedData:
    """The inputs of training. `omega` (n,) is ω̃ of each training sample, `repeats` its repetitions per epoch.

    `reference_states` is None if neither β nor λ_H needs them.
    """

    train: tuple[EncodedSample, ...]
    held_out: tuple[EncodedSample, ...]
    repeats: tuple[int, ...]
    omega: NDArray[np.float64]
    reference_states: ReferenceStates | None


def prepare_data(
    lora_model: LoraModel,
    dataset: Dataset,
    config: ObjectiveConfig,
    base: str,
    states_file: Path,
    process_group: ProcessGroup = SINGLE_PROCESS,
) -> PreparedData:
    """`dataset` for `lora_model`, whose base has the hash `base`; reference states are cached in `states_file`.

    In a process group the first process writes the file and all read it. Raises `ConfigurationError` if there are no
    training samples, a sample is too long, or the logits of the base do not follow from its hidden states;
    `FileWriteError`.
    """
    if not dataset.train:
        raise ConfigurationError.stating("There are no training samples.", fix="Lower `[curation] held_out`.")
    train, held_out = (
        tuple(encode_sample(lora_model.tokenizer, row, lora_model.max_tokens) for row in rows)
        for rows in (dataset.train, dataset.held_out)
    )
    lora_model.check_logits(train[0])
    states = (
        _load_reference_states(lora_model, train, base, states_file, process_group)
        if _needs_reference_states(config)
        else None
    )
    entropies: Any = states.entropies(train) if states else np.zeros(len(train))
    repeats = tuple(row.repeats for row in dataset.train)
    weights = sample_weights([row.weight for row in dataset.train], entropies, config)
    tokens = [len(one.contract) for one in train]
    return PreparedData(
        train=train,
        held_out=held_out,
        repeats=repeats,
        omega=normalize_weights(weights, tokens, repeats),
        reference_states=states,
    )


def _needs_reference_states(config: ObjectiveConfig) -> bool:
    return config.beta > 0.0 or (config.lambda_h > 0.0 and config.entropy_gate == "sample")


def _load_reference_states(
    lora_model: LoraModel, train: tuple[EncodedSample, ...], base: str, states_file: Path, process_group: ProcessGroup
) -> ReferenceStates:
    key = states_key(base, train, lora_model.number_format)
    process_group.run_on_first(lambda: _compute_reference_states(lora_model, train, states_file, key))
    found = load_states(states_file, key, device=str(lora_model.head.device))
    if found is None:
        fix = f"Name a folder that every host can read. {states_file}"
        raise ConfigurationError.stating("The file with the states of the base cannot be read.", fix=fix)
    return found


def _compute_reference_states(
    lora_model: LoraModel, train: tuple[EncodedSample, ...], states_file: Path, key: str
) -> None:
    """Compute the states of the base, unless they are cached."""
    if load_states(states_file, key) is None:
        with lora_model.without_adapter():
            save_states(
                compute_states(lora_model.decoder, lora_model.head, train, lora_model.padding_id), states_file, key
            )
