"""A map of memory: all embeddings on two axes, for a picture coloured by weight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualbrain.memory.memory import Memory

MAX_PCA_SAMPLES = 2000
"""The axes are found from at most this many memories, spread evenly over time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MemoryProjection:
    """Points of shape (n, 2), weights w of shape (n,), ids and outcomes, and the share of variance the axes show."""

    points: NDArray[np.float64]
    weights: NDArray[np.float64]
    episode_ids: tuple[str, ...]
    kinds: tuple[str, ...]
    statuses: tuple[str, ...]
    explained_variance: float


def project_memories(memory: Memory) -> MemoryProjection:
    """The first two principal axes of the embeddings with their blocks weighted by √α: e − ē = U S V', points = U S.

    Distances on the map are those of the joint embedding, as far as two axes can show them; signs are fixed (the entry
    of largest size in each axis is positive), so that the same memory draws the same map.
    """
    state, rows = memory.state, memory.index.flat_index.rows
    scale = np.sqrt(memory.embedding.expand_alpha(memory.config.embedding.alpha)).astype(np.float64)
    chosen = np.unique(np.linspace(0, max(0, len(rows) - 1), min(len(rows), MAX_PCA_SAMPLES)).round().astype(np.intp))
    sample = rows[chosen].astype(np.float64) * scale
    points, shown = np.zeros((len(rows), 2)), 0.0
    if len(rows) > 1:
        centre = sample.mean(axis=0)
        _, spread, axes = np.linalg.svd(sample - centre, full_matrices=False)
        axes = axes[:2] * np.sign(axes[:2][np.arange(len(axes[:2])), np.abs(axes[:2]).argmax(axis=1)])[:, None]
        points[:, : len(axes)] = (rows.astype(np.float64) * scale - centre) @ axes.T
        total = float((spread**2).sum())
        shown = float((spread[:2] ** 2).sum() / total) if total > 0.0 else 0.0
    return MemoryProjection(
        points=points,
        weights=np.array([memo.weight for memo in state.memories]),
        episode_ids=tuple(memo.id for memo in state.memories),
        kinds=tuple(memo.kind for memo in state.memories),
        statuses=tuple(memo.status for memo in state.memories),
        explained_variance=shown,
    )
