"""Grouping of episodes by scene, so that no scene is on both sides of the split."""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence

import numpy as np

from dualbrain.adaptation.curation.candidate import Candidate
from dualbrain.records import Scene

SAME_SCENE_DISTANCE = 0.03
"""Two scenes with the same objects, each displaced by at most this distance [m], count as one scene. It is more than
twice the bound of the perception error (9 mm) and less than the grid on which generated scenes differ."""


def group_scenes(episodes: Sequence[Candidate]) -> list[str]:
    """The group of every episode: episodes with the same group must be on one side of the split.

    Two episodes are linked if the same objects were at the same positions up to `SAME_SCENE_DISTANCE`, or if the
    planner received the same scene summary; groups are the connected components. The group is named by a hash of the id
    of its oldest memory, so the name is stable when later episodes join and when the ledger is compacted: group all
    episodes, not only the selected ones.
    """
    root = list(range(len(episodes)))

    def top(i: int) -> int:
        while root[i] != i:
            root[i] = root[root[i]]
            i = root[i]
        return i

    for i, j in _linked_pairs(episodes):
        first, second = sorted((top(i), top(j)))
        root[second] = first
    return [_group_name(episodes[top(i)]) for i in range(len(episodes))]


def choose_held_out_groups(groups: Sequence[str], share: float, salt: str) -> frozenset[str]:
    """The groups whose hash with `salt` is below `share`: at least one, never all; none if `share` is 0.

    `groups` has one name per sample. A group with more than `share` of all samples is used for training, because it is
    the robot's most frequent task; unless this applies to every group.

    A group stays on its side when other groups are added, so later rounds are tested on scenes that no round was
    trained on. Exceptions: the at-least-one rule, and a group that grows above or falls below `share` of all samples.
    """
    counts = Counter(groups)
    if share <= 0.0 or len(counts) < 2:
        return frozenset()
    eligible = [group for group, count in counts.items() if count <= share * len(groups)] or list(counts)
    fractions = sorted((_hash_fraction(group, salt), group) for group in eligible)
    chosen = [group for fraction, group in fractions if fraction < share] or [fractions[0][1]]
    return frozenset(chosen[: len(counts) - 1])


def _linked_pairs(found: Sequence[Candidate]) -> Iterator[tuple[int, int]]:
    """Pairs of the same scene or the same summary, enough of them to connect each group."""
    first_with_summary: dict[str, int] = {}
    same_objects = defaultdict[tuple[str, ...], list[int]](list)
    for i, one in enumerate(found):
        yield first_with_summary.setdefault(one.summary, i), i
        same_objects[_object_names(one.scene)].append(i)
    for rows in same_objects.values():
        positions = np.stack([_positions(found[i].scene) for i in rows])
        for a in range(1, len(rows)):
            offsets = np.linalg.norm(positions[:a] - positions[a], axis=2).max(axis=1, initial=0.0)
            yield from ((rows[int(b)], rows[a]) for b in np.flatnonzero(offsets <= SAME_SCENE_DISTANCE))


def _object_names(scene: Scene) -> tuple[str, ...]:
    return tuple(sorted(obj.name for obj in scene.objects if obj.role != "person"))


def _positions(scene: Scene) -> np.ndarray:
    """Positions of all objects but people in the order of their names, shape (n_objects, 3) [m]."""
    objects = sorted((obj.name, obj.pose.position) for obj in scene.objects if obj.role != "person")
    return np.array([position for _, position in objects], float).reshape(len(objects), 3)


def _group_name(oldest: Candidate) -> str:
    return hashlib.sha256(oldest.memory.id.encode()).hexdigest()[:16]


def _hash_fraction(group: str, salt: str) -> float:
    """A number in [0, 1) for `group`."""
    return int(hashlib.sha256(f"{salt}:{group}".encode()).hexdigest()[:13], 16) / 16**13
