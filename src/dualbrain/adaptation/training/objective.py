"""The objective (paper 6.2): weighted cross-entropy, and a KL term that keeps the planner near its starting model.

    L = Σ_i ω_i Σ_t CE_it / Σ_i ω_i n_i  +  β Σ_i Σ_t KL(p_θ ‖ p_θ0)_it / Σ_i n_i

over the n_i tokens t of each contract i, teacher-forced; prompt tokens do not count. The normaliser is our choice: with
ω = 1 and β = 0, L is the mean cross-entropy of plain supervised fine-tuning.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dualbrain.adaptation.config import ObjectiveConfig

TOP_K = 20
"""K of the token gate."""


class Loss(NamedTuple):
    """The total loss, and the unweighted means over tokens [nats], detached."""

    total: Tensor
    cross_entropy: Tensor
    divergence: Tensor


def objective(
    hidden: Tensor,
    head: Tensor,
    labels: Tensor,
    omega: Tensor,
    tokens: float,
    *,
    beta: float = 0.0,
    base_hidden: Tensor | None = None,
    token_gate: bool = False,
) -> Loss:
    """The share of some tokens in L of a step with `tokens` tokens: the shares of all parts of a step sum to L.

    `hidden` (n, d) are final-norm hidden states at the positions that predict `labels` (n,), `head` (V, d) is the
    frozen output matrix, so the logits are hidden·headᵀ. `omega` (n,) is ω̃ of each token's sample (see
    `normalize_weights`). `base_hidden` (n, d) are the starting model's states at the same positions: with the same head
    they give p_θ0 exactly. The divergence is KL(p_θ ‖ p_θ0), adapted model first. `token_gate` weights each token with
    H̃_t ∈ [0, 1] (see `token_entropy_gate`).
    """
    log_p = log_probabilities(hidden, head)
    ce = -log_p.gather(1, labels[:, None]).squeeze(1)
    gate = token_entropy_gate(log_p) if token_gate else 1.0
    total = (omega * gate * ce).sum() / tokens
    kl = torch.zeros((), device=ce.device)
    if beta > 0.0 and base_hidden is not None:
        with torch.no_grad():
            log_q = log_probabilities(base_hidden, head)
        kl = kl_divergence(log_p, log_q).sum()
        total = total + beta * kl / tokens
    return Loss(total, ce.detach().sum() / tokens, kl.detach() / tokens)


def log_probabilities(hidden: Tensor, head: Tensor) -> Tensor:
    """Log-probabilities log softmax(hidden·headᵀ) in float32, shape (n, V)."""
    return (hidden.to(head.dtype) @ head.T).float().log_softmax(-1)


def kl_divergence(log_p: Tensor, log_q: Tensor) -> Tensor:
    """KL(p ‖ q) = Σ_v p_v (log p_v − log q_v) of each row [nats], shape (n,): at least 0, and 0 only if p = q."""
    return (log_p.exp() * (log_p - log_q)).sum(-1)


def entropy(log_p: Tensor) -> Tensor:
    """H(p) = −Σ_v p_v log p_v of each row over the whole vocabulary [nats], shape (n,)."""
    return -(log_p.exp() * log_p).sum(-1)


def token_entropy_gate(log_p: Tensor) -> Tensor:
    """H̃_t = H(top 20 of p_t) / ln 20 ∈ [0, 1], detached: the gate of EAFT (Diao et al. 2026, arXiv 2601.02151).

    It suppresses tokens that the present model is sure of, right or wrong. It is an ablation, because a planner is
    often sure of wrong values at physical limits.
    """
    k = min(TOP_K, log_p.shape[-1])
    top = log_p.detach().topk(k, dim=-1).values.log_softmax(-1)
    return entropy(top) / math.log(k)


Array = NDArray[np.float64]

LOW_PERCENTILE, HIGH_PERCENTILE = 5.0, 95.0
"""Entropies are clipped at these percentiles: most mean entropies of contracts are close together, and one outlier
would determine the scale."""
MIN_ENTROPY_SPREAD = 1e-6
"""A range of entropies [nats] up to this value counts as zero."""


def sample_weights(memory_weights: Sequence[float], entropies: Sequence[float], config: ObjectiveConfig) -> Array:
    """ω of each sample, shape (n,). ŵ_i is its memory weight w_i ∈ [0, 1], Ĥ_i its entropy scaled to [0, 1].

    H_i [nats] is the mean entropy of the starting model over the contract's tokens. λ_H has an effect with the gate
    "sample" only. Law: ω ≥ 1, ω = 1 everywhere if both λ are 0, and ω increases with w and with H.
    """
    w = np.clip(np.asarray(memory_weights, float), 0.0, 1.0)
    lambda_h = config.lambda_h if config.entropy_gate == "sample" else 0.0
    return 1.0 + config.lambda_w * w + lambda_h * scale_entropies(np.asarray(entropies, float))


def scale_entropies(entropies: Array) -> Array:
    """`entropies` clipped at their 5th and 95th percentile and scaled to [0, 1]; all 0 if they do not differ."""
    if not len(entropies):
        return entropies
    low, high = np.percentile(entropies, [LOW_PERCENTILE, HIGH_PERCENTILE])
    return (
        np.clip((entropies - low) / (high - low), 0.0, 1.0)
        if high - low > MIN_ENTROPY_SPREAD
        else np.zeros_like(entropies)
    )


def normalize_weights(weights: Array, tokens: Sequence[int], repeats: Sequence[int]) -> Array:
    """ω̃_i = ω_i / ω̄ with ω̄ = Σ ω_i n_i / Σ n_i over an epoch (n_i `tokens`, each sample with its `repeats`).

    L divides by Σ ω_i n_i. Dividing each batch by its own sum would cancel ω (completely for one sample per batch);
    dividing once by the sum of the data set gives L, and the effective learning rate does not depend on λ.
    """
    n = np.asarray(tokens, float) * np.asarray(repeats, float)
    return weights * (n.sum() / (weights * n).sum())
