"""The value model: a ridge regression of each alternative's advantage over its siblings on the symbols of the scene.

With the utilities U_pa of the alternatives a at the places p (`utility.py`) and the symbols x_p (`symbols.py`),

    y_pa = U_pa − mean over the executed alternatives at p,    W_a = (X_aᵀ X_a + λ I)⁻¹ X_aᵀ y_a

The difficulty of a place cancels in y. The standard deviation of a prediction is that of the Bayesian linear model with
the same λ and the residual variance σ². A linear model on a few symbols needs about 100 executions and can be read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.adaptation.value_model.symbols import SYMBOLS, Placement, symbol_vector
from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.core.untrusted.bounded_file import read_bounded_file
from dualbrain.errors import DECODE_ERRORS, ConfigurationError

Array = NDArray[np.float64]

RIDGE = 2.0
"""λ, fixed before the first evaluation."""
CHOICE_MARGIN = 0.05
"""Least predicted advantage over the default alternative: smaller ones are noise at 100 places, and cost nothing."""
MAX_FILE_BYTES = 4 << 20
SCHEMA_VERSION = 1
VALUE_MODEL_FILE = "value_model.json"
"""Name of the file beside the data that a value model chose."""


class ExecutedSiblings(msgspec.Struct, frozen=True):
    """The alternatives that were executed at one place, with their utilities."""

    placement: Placement
    utilities: dict[str, float]


class RankedAlternative(msgspec.Struct, frozen=True):
    """One alternative with its predicted advantage over the mean of its siblings, and the standard deviation."""

    name: str
    advantage: float
    deviation: float


class ValueModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Weights (symbols,) and inverse information matrix (symbols, symbols) of each alternative, and σ².

    `executions` is the number of executed contracts, `data` the hash of the trials.
    """

    weights: dict[str, list[float]]
    covariances: dict[str, list[list[float]]]
    variance: float
    executions: int
    data: str = ""
    symbols: tuple[str, ...] = SYMBOLS
    schema_version: int = SCHEMA_VERSION

    def rank(self, placement: Placement, names: Sequence[str] | None = None) -> tuple[RankedAlternative, ...]:
        """The alternatives `names` (by default all that are known) at `placement`, the best first."""
        x = symbol_vector(placement)
        known = [name for name in (names if names is not None else self.weights) if name in self.weights]
        ranked = [
            RankedAlternative(
                name,
                float(x @ np.array(self.weights[name])),
                float(np.sqrt(self.variance * (x @ np.array(self.covariances[name]) @ x))),
            )
            for name in known
        ]
        return tuple(sorted(ranked, key=lambda one: -one.advantage))

    def choose(self, placement: Placement, names: Sequence[str], default: str) -> str:
        """The alternative to execute: `default`, unless another is predicted better by more than `CHOICE_MARGIN`.

        Contracts are then a simple function of the scene, which a small language model can learn.
        """
        ranked = self.rank(placement, names)
        predicted = {one.name: one.advantage for one in ranked}
        if not ranked or (default in predicted and ranked[0].advantage <= predicted[default] + CHOICE_MARGIN):
            return default
        return ranked[0].name


def fit_value_model(places: Sequence[ExecutedSiblings], *, ridge: float = RIDGE, data: str = "") -> ValueModel:
    """The value model of executed siblings; raises `ConfigurationError` without a place with two alternatives."""
    compared = [place for place in places if len(place.utilities) > 1]
    if not compared:
        problem = "The value model needs a place at which two alternatives were executed."
        raise ConfigurationError.stating(problem, fix="Explore more places.")
    symbols = np.array([symbol_vector(place.placement) for place in compared])
    advantages = [_advantages(place.utilities) for place in compared]
    weights: dict[str, list[float]] = {}
    covariances: dict[str, list[list[float]]] = {}
    residuals: list[float] = []
    for name in sorted({name for one in advantages for name in one}):
        rows = [row for row, one in enumerate(advantages) if name in one]
        x, y = symbols[rows], np.array([advantages[row][name] for row in rows])
        inverse = np.linalg.inv(x.T @ x + ridge * np.eye(x.shape[1]))
        w = inverse @ x.T @ y
        weights[name], covariances[name] = w.tolist(), inverse.tolist()
        residuals += (y - x @ w).tolist()
    executions = sum(len(place.utilities) for place in compared)
    return ValueModel(
        weights=weights, covariances=covariances, variance=float(np.var(residuals)), executions=executions, data=data
    )


def _advantages(utilities: Mapping[str, float]) -> dict[str, float]:
    """Each utility minus the mean of all."""
    mean = float(np.mean(list(utilities.values())))
    return {name: value - mean for name, value in utilities.items()}


def best_fixed_alternative(places: Sequence[ExecutedSiblings]) -> str:
    """The alternative with the highest mean utility over the places at which it was executed."""
    totals: dict[str, list[float]] = {}
    for place in places:
        for name, value in place.utilities.items():
            totals.setdefault(name, []).append(value)
    return max(sorted(totals), key=lambda name: float(np.mean(totals[name])))


def save_value_model(model: ValueModel, path: Path) -> None:
    """Write `model` as JSON; raises `FileWriteError`."""
    write_atomically(path, msgspec.json.format(msgspec.json.encode(model), indent=1) + b"\n")


def load_value_model(path: Path) -> ValueModel:
    """Read a value model; raises `ConfigurationError` for an unreadable or inconsistent file, or other symbols."""
    try:
        model = msgspec.json.decode(read_bounded_file(path, MAX_FILE_BYTES), type=ValueModel)
    except DECODE_ERRORS as error:
        fix = f"Explore again, or restore the file. {path}"
        raise ConfigurationError.stating(f"The value model cannot be read: {error}.", fix=fix) from error
    if model.symbols != SYMBOLS or model.schema_version != SCHEMA_VERSION:
        problem = f"The value model was fitted with other symbols of the scene: {', '.join(model.symbols)}."
        raise ConfigurationError.stating(problem, fix=f"Fit it again from its trials. {path}")
    if not _is_consistent(model):
        problem = "The value model lacks a number of one of its alternatives, or has one that is not finite."
        raise ConfigurationError.stating(problem, fix=f"Fit it again from its trials. {path}")
    return model


def _is_consistent(model: ValueModel) -> bool:
    """Whether every alternative has a weight for each symbol and a matrix of their size, and σ² is at least 0."""
    size = len(model.symbols)
    rows = [*model.weights.values(), *(row for matrix in model.covariances.values() for row in matrix)]
    return (
        model.weights.keys() == model.covariances.keys()
        and all(len(matrix) == size for matrix in model.covariances.values())
        and all(len(row) == size and np.isfinite(row).all() for row in rows)
        and 0.0 <= model.variance < np.inf
    )
