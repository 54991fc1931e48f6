"""A collision-free path in joint space: RRT-Connect (Kuffner and LaValle, 2000), then random shortcuts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
IsFree = Callable[[Array], NDArray[np.bool_]]
"""Whether each of the postures (t, n) is free."""

STEP = 0.25
"""Length of an extension of a tree, the largest change of a joint [rad]."""
RESOLUTION = 0.04
"""Distance between two checked postures of an edge [rad]."""
MAX_EXTENSIONS, N_SHORTCUTS = 1500, 60


@dataclass(frozen=True, slots=True)
class JointRange:
    """Lower and upper limits (n,) of the joints [rad]."""

    lower: Array
    upper: Array


def find_path(is_free: IsFree, limits: JointRange, start: Array, goal: Array, rng: np.random.Generator) -> Array | None:
    """A path (k, n) [rad] from `start` to `goal` of free edges, None without one after `MAX_EXTENSIONS`."""
    near, far = _Tree(start), _Tree(goal)
    for _ in range(MAX_EXTENSIONS):
        reached = near.extend(rng.uniform(limits.lower, limits.upper), is_free)
        while reached is not None:
            node = near.nodes[-1]
            reached = far.extend(node, is_free)
            if reached is not None and np.array_equal(far.nodes[-1], node):
                one, other = near.branch(), far.branch()
                forward = near.nodes[0] is start
                path = np.array([*one, *other[::-1]] if forward else [*other, *one[::-1]])
                return _shorten(path, is_free, rng)
        near, far = far, near
    return None


class _Tree:
    """A tree of postures with the index of the parent of each."""

    def __init__(self, root: Array) -> None:
        self.nodes, self._parents = [root], [-1]

    def extend(self, target: Array, is_free: IsFree) -> Array | None:
        """Add the posture one step towards `target` from the nearest node; None if the edge is not free."""
        distances = np.abs(np.array(self.nodes) - target).max(axis=1)
        nearest = int(np.argmin(distances))
        node, distance = self.nodes[nearest], float(distances[nearest])
        new = target if distance <= STEP else node + (target - node) * (STEP / distance)
        if distance == 0.0 or not is_free(edge_points(node, new)).all():
            return None
        self.nodes.append(new)
        self._parents.append(nearest)
        return new

    def branch(self) -> list[Array]:
        """The postures from the root to the last node."""
        index, found = len(self.nodes) - 1, list[Array]()
        while index >= 0:
            found.append(self.nodes[index])
            index = self._parents[index]
        return found[::-1]


def edge_points(a: Array, b: Array) -> Array:
    """Postures (t, n) along the edge from `a` to `b`, at most `RESOLUTION` apart, without `a`."""
    count = max(1, int(np.ceil(np.abs(b - a).max() / RESOLUTION)))
    return a + (b - a) * (np.arange(1, count + 1) / count)[:, None]


def _shorten(path: Array, is_free: IsFree, rng: np.random.Generator) -> Array:
    for _ in range(N_SHORTCUTS):
        if len(path) < 3:
            break
        i, k = sorted(rng.choice(len(path), 2, replace=False).tolist())
        if k - i > 1 and is_free(edge_points(path[i], path[k])).all():
            path = np.concatenate([path[: i + 1], path[k:]])
    return np.concatenate([path[:1], *(edge_points(a, b) for a, b in pairwise(path))])
