"""Projection of all embeddings onto two principal axes, for a plot of the memory coloured by weight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualbrain.memory.memory import Memory

MAX_PCA_SAMPLES = 2000
"""The axes are computed from at most this many memories, spread evenly over time."""
MAX_POINTS = 20_000
"""At most this many memories are projected, spread evenly over time; their vectors may be on the disk."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MemoryProjection:
    """Points of shape (n, 2), weights w of shape (n,), ids, outcomes, statuses, and the explained share of variance."""

    points: NDArray[np.float64]
    weights: NDArray[np.float64]
    episode_ids: tuple[str, ...]
    kinds: tuple[str, ...]
    statuses: tuple[str, ...]
    explained_variance: float


def project_memories(memory: Memory) -> MemoryProjection:
    """Project the embeddings, with blocks weighted by √α, onto two principal axes: e − ē = U S V', points = U S.

    Distances between points approximate those of the joint embedding. The sign of each axis is fixed (its entry of
    largest magnitude is positive), so that the same memory has the same projection.
    """
    shown = _spread(len(memory), MAX_POINTS)
    memories, rows = [memory.state.memories[int(row)] for row in shown], memory.index.vectors(shown)
    scale = np.sqrt(memory.embedding.expand_alpha(memory.config.embedding.alpha)).astype(np.float64)
    chosen = _spread(len(rows), MAX_PCA_SAMPLES)
    sample = rows[chosen].astype(np.float64) * scale
    points, explained = np.zeros((len(rows), 2)), 0.0
    if len(rows) > 1:
        mean = sample.mean(axis=0)
        _, singular_values, axes = np.linalg.svd(sample - mean, full_matrices=False)
        axes = axes[:2] * np.sign(axes[:2][np.arange(len(axes[:2])), np.abs(axes[:2]).argmax(axis=1)])[:, None]
        points[:, : len(axes)] = (rows.astype(np.float64) * scale - mean) @ axes.T
        total = float((singular_values**2).sum())
        explained = float((singular_values[:2] ** 2).sum() / total) if total > 0.0 else 0.0
    return MemoryProjection(
        points=points,
        weights=np.array([memo.weight for memo in memories]),
        episode_ids=tuple(memo.id for memo in memories),
        kinds=tuple(memo.kind for memo in memories),
        statuses=tuple(memo.status for memo in memories),
        explained_variance=explained,
    )


def _spread(n: int, most: int) -> NDArray[np.intp]:
    """At most `most` of the rows 0 … n − 1, spread evenly."""
    return np.unique(np.linspace(0, max(0, n - 1), min(n, most)).round().astype(np.intp))
