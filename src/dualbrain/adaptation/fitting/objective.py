"""The objective (paper 6.2): weighted cross-entropy, and a KL term that keeps the planner near the one it started as.

    L = Σ_i ω_i Σ_t CE_it / Σ_i ω_i n_i  +  β Σ_i Σ_t KL(p_θ ‖ p_θ0)_it / Σ_i n_i

over the n_i tokens t of each contract i, teacher-forced; the prompt teaches nothing. The normaliser is ours: with
ω = 1 and β = 0 this is the mean cross-entropy of plain supervised fine-tuning.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

TOP = 20
"""K of the token gate."""


class Loss(NamedTuple):
    """The value to descend, and beside it the unweighted means over tokens [nats], detached."""

    total: Tensor
    cross_entropy: Tensor
    divergence: Tensor


def objective(
    hidden: Tensor, head: Tensor, labels: Tensor, omega: Tensor, tokens: float, *, beta: float = 0.0,
    base_hidden: Tensor | None = None, token_gate: bool = False,
) -> Loss:  # fmt: skip
    """L of some tokens as their share of a step of `tokens` tokens: the parts of a step sum to it.

    `hidden` (n, d) are final-norm hidden states at the places that predict `labels` (n,), `head` (V, d) the frozen
    output matrix, so logits are hidden·headᵀ. `omega` (n,) is ω̃ of the sample of each token (see `omega.normalised`).
    `base_hidden` (n, d) are the starting model's states at the same places: with the same head they give p_θ0 exactly.
    The divergence has the adapted p_θ first. `token_gate` weighs each token with H̃_t ∈ [0, 1] (see `soft_gate`).
    """
    log_p = log_probabilities(hidden, head)
    ce = -log_p.gather(1, labels[:, None]).squeeze(1)
    gate = soft_gate(log_p) if token_gate else 1.0
    total = (omega * gate * ce).sum() / tokens
    kl = torch.zeros((), device=ce.device)
    if beta > 0.0 and base_hidden is not None:
        with torch.no_grad():
            log_q = log_probabilities(base_hidden, head)
        kl = divergence(log_p, log_q).sum()
        total = total + beta * kl / tokens
    return Loss(total, ce.detach().sum() / tokens, kl.detach() / tokens)


def log_probabilities(hidden: Tensor, head: Tensor) -> Tensor:
    """The logarithm of softmax(hidden·headᵀ) in float32, shape (n, V)."""
    return (hidden.to(head.dtype) @ head.T).float().log_softmax(-1)


def divergence(log_p: Tensor, log_q: Tensor) -> Tensor:
    """KL(p ‖ q) = Σ_v p_v (log p_v − log q_v) of each row [nats], shape (n,): at least 0, and 0 only where p = q."""
    return (log_p.exp() * (log_p - log_q)).sum(-1)


def entropy(log_p: Tensor) -> Tensor:
    """H(p) = −Σ_v p_v log p_v of each row over the whole vocabulary [nats], shape (n,)."""
    return -(log_p.exp() * log_p).sum(-1)


def soft_gate(log_p: Tensor) -> Tensor:
    """H̃_t = H(top 20 of p_t) / ln 20 ∈ [0, 1], detached: the entropy gate of EAFT (Diao et al. 2026, arXiv 2601.02151).

    It silences tokens that the present model is sure of, right or wrong; an ablation, for limits of a body often are
    what a planner is wrongly sure of.
    """
    k = min(TOP, log_p.shape[-1])
    top = log_p.detach().topk(k, dim=-1).values.log_softmax(-1)
    return entropy(top) / math.log(k)
