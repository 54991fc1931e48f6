"""A data set made ready for one learner: tokens, weights ω̃, and the base's states."""

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
    """What a fit reads. `omega` (n,) is ω̃ of each training sample, `shown` how often an epoch shows it.

    `states` is None where neither β nor λ_H asks for them.
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
    """`dataset` for `learner`, whose base has the hash `base`; the base's states are read from `kept` or written there.

    In a team the first process writes them and all read them. Raises `InvalidSetup` if there is nothing to train on, a
    sample is too long, or the base cannot be cached exactly.
    """
    if not dataset.train:
        raise ConfigurationError("training samples", got="none", allowed="at least one", fix="Lower curation held_out.")
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
    shown = tuple(row.repeats for row in dataset.train)
    weights = sample_weights([row.weight for row in dataset.train], entropies, config)
    tokens = [len(one.contract) for one in train]
    return PreparedData(
        train=train,
        held_out=held_out,
        repeats=shown,
        omega=normalize_weights(weights, tokens, shown),
        reference_states=states,
    )


def _needs_reference_states(dials: ObjectiveConfig) -> bool:
    return dials.beta > 0.0 or (dials.lambda_h > 0.0 and dials.entropy_gate == "sample")


def _load_reference_states(
    learner: LoraModel, train: tuple[EncodedSample, ...], base: str, kept: Path, team: ProcessGroup
) -> ReferenceStates:
    key = states_key(base, train, learner.number_format)
    team.run_on_first(lambda: _compute_reference_states(learner, train, kept, key))
    found = load_states(kept, key, device=str(learner.head.device))
    if found is None:
        fix = f"Name a folder that every host of the fit sees. {kept}"
        raise ConfigurationError(
            "states of the base", got="none", allowed="those that the first process wrote", fix=fix
        )
    return found


def _compute_reference_states(learner: LoraModel, train: tuple[EncodedSample, ...], kept: Path, key: str) -> None:
    """Compute the base's states, unless they are kept already."""
    if load_states(kept, key) is None:
        with learner.without_adapter():
            save_states(compute_states(learner.decoder, learner.head, train, learner.padding_id), kept, key)
