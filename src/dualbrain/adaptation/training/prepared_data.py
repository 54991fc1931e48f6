"""A data set made ready for one learner: tokens, weights ω̃, and the base's states."""

# pyright: reportMissingImports=false

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualbrain.adaptation.config import ObjectiveDials
from dualbrain.adaptation.curation.dataset import Dataset
from dualbrain.adaptation.training.model.batching import Encoded, encode
from dualbrain.adaptation.training.model.lora_model import Learner
from dualbrain.adaptation.training.objective import normalised, omega
from dualbrain.adaptation.training.process_group import ALONE, Team
from dualbrain.adaptation.training.reference_states import BaseStates, compute, find, keep, key_of
from dualbrain.errors import InvalidSetup


@dataclass(frozen=True, slots=True)
class Taught:
    """What a fit reads. `omega` (n,) is ω̃ of each training sample, `shown` how often an epoch shows it.

    `states` is None where neither β nor λ_H asks for them.
    """

    train: tuple[Encoded, ...]
    held_out: tuple[Encoded, ...]
    shown: tuple[int, ...]
    omega: NDArray[np.float64]
    states: BaseStates | None


def prepare(
    learner: Learner, dataset: Dataset, dials: ObjectiveDials, base: str, kept: Path, team: Team = ALONE
) -> Taught:
    """`dataset` for `learner`, whose base has the hash `base`; the base's states are read from `kept` or written there.

    In a team the first process writes them and all read them. Raises `InvalidSetup` if there is nothing to train on, a
    sample is too long, or the base cannot be cached exactly.
    """
    if not dataset.train:
        raise InvalidSetup("training samples", got="none", allowed="at least one", fix="Lower curation held_out.")
    train, held_out = (
        tuple(encode(learner.tokenizer, row, learner.longest) for row in rows)
        for rows in (dataset.train, dataset.held_out)
    )
    learner.check(train[0])
    states = _states(learner, train, base, kept, team) if _needed(dials) else None
    entropies: Any = states.entropies(train) if states else np.zeros(len(train))
    shown = tuple(row.repeats for row in dataset.train)
    weights = omega([row.weight for row in dataset.train], entropies, dials)
    tokens = [len(one.contract) for one in train]
    return Taught(train, held_out, shown, normalised(weights, tokens, shown), states)


def _needed(dials: ObjectiveDials) -> bool:
    return dials.beta > 0.0 or (dials.lambda_h > 0.0 and dials.entropy_gate == "sample")


def _states(learner: Learner, train: tuple[Encoded, ...], base: str, kept: Path, team: Team) -> BaseStates:
    key = key_of(base, train, learner.numbers)
    team.once(lambda: _keep_states(learner, train, kept, key))
    found = find(kept, key, device=str(learner.head.device))
    if found is None:
        fix = f"Name a folder that every host of the fit sees. {kept}"
        raise InvalidSetup("states of the base", got="none", allowed="those that the first process wrote", fix=fix)
    return found


def _keep_states(learner: Learner, train: tuple[Encoded, ...], kept: Path, key: str) -> None:
    """Compute the base's states, unless they are kept already."""
    if find(kept, key) is None:
        with learner.as_base():
            keep(compute(learner.decoder, learner.head, train, learner.padding), kept, key)
