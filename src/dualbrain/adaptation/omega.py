"""Weights of samples: ω_i = 1 + λ_w ŵ_i + λ_H Ĥ_i (paper 6.2), each at least 1."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dualbrain.adaptation.config import ObjectiveDials

Values = NDArray[np.float64]

LOW, HIGH = 5.0, 95.0
"""Entropies are cut at these percentiles: the means of whole contracts lie close together, and one odd one would else
take the whole scale."""
LEAST = 1e-6
"""A spread of entropies [nats] up to this is none."""


def omega(memory_weights: Sequence[float], entropies: Sequence[float], dials: ObjectiveDials) -> Values:
    """ω of each sample, shape (n,). ŵ_i is its memory weight w_i ∈ [0, 1], Ĥ_i its entropy scaled to [0, 1].

    H_i [nats] is the mean entropy of the round's starting model over the contract's tokens. λ_H acts with the gate
    "sample" only. Law: ω ≥ 1, ω = 1 everywhere if both λ are 0, and ω rises with w and with H.
    """
    w = np.clip(np.asarray(memory_weights, float), 0.0, 1.0)
    lambda_h = dials.lambda_h if dials.entropy_gate == "sample" else 0.0
    return 1.0 + dials.lambda_w * w + lambda_h * scaled(np.asarray(entropies, float))


def scaled(entropies: Values) -> Values:
    """`entropies` cut at their 5th and 95th percentile and brought to [0, 1]; all 0 if they do not differ."""
    if not len(entropies):
        return entropies
    low, high = np.percentile(entropies, [LOW, HIGH])
    return np.clip((entropies - low) / (high - low), 0.0, 1.0) if high - low > LEAST else np.zeros_like(entropies)


def normalised(weights: Values, tokens: Sequence[int], shown: Sequence[int]) -> Values:
    """ω̃_i = ω_i / ω̄ with ω̄ = Σ ω_i n_i / Σ n_i over all that an epoch shows (n_i `tokens`, each `shown` times).

    L divides by Σ ω_i n_i. Dividing each batch by its own sum would undo ω (wholly, with one sample a batch); dividing
    once by that of the data set keeps L, and no λ changes the effective learning rate.
    """
    n = np.asarray(tokens, float) * np.asarray(shown, float)
    return weights * (n.sum() / (weights * n).sum())
