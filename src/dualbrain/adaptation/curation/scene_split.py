"""Which episodes were in the same scene, so that a scene never stands on both sides of the split."""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence

import numpy as np

from dualbrain.adaptation.curation.candidate import Candidate
from dualbrain.records import Scene

SAME_SCENE_DISTANCE = 0.03
"""Scenes of the same things at most this far from each other [m] are one scene, seen twice: above twice the bound of
the perception error (9 mm), below the grid on which scenes differ."""


def group_scenes(found: Sequence[Candidate]) -> list[str]:
    """A name for the scene of each of `found`: equal names for what must stay on one side.

    Two episodes are linked if the same things stood at the same places up to `SAME_SCENE`, or if the planner was told
    the same of them; links are followed to the end. The name is a hash of the oldest memory's id, so it does not change
    when later ones join, nor when a ledger is compacted: name the scenes of all that happened, not of what is chosen.
    """
    root = list(range(len(found)))

    def top(i: int) -> int:
        while root[i] != i:
            root[i] = root[root[i]]
            i = root[i]
        return i

    for i, j in _linked_pairs(found):
        first, second = sorted((top(i), top(j)))
        root[second] = first
    return [_group_name(found[top(i)]) for i in range(len(found))]


def choose_held_out_groups(groups: Sequence[str], share: float, salt: str) -> frozenset[str]:
    """The groups whose hash with `salt` falls below `share`; at least one and never all, if `share` > 0.

    `groups` has a name for each sample. What alone makes up more than `share` of them teaches, for it is what the robot
    does most of all; unless each group does.
    Promise: a group keeps its side when others join (but for that at-least-one, and for what comes to be that large),
    so that later rounds are tested on scenes that no round has seen.
    """
    counts = Counter(groups)
    if share <= 0.0 or len(counts) < 2:
        return frozenset()
    fit = [group for group, count in counts.items() if count <= share * len(groups)] or list(counts)
    places = sorted((_hash_fraction(group, salt), group) for group in fit)
    chosen = [group for place, group in places if place < share] or [places[0][1]]
    return frozenset(chosen[: len(counts) - 1])


def _linked_pairs(found: Sequence[Candidate]) -> Iterator[tuple[int, int]]:
    """Pairs of the same scene or the same summary; enough of them to connect each group."""
    told: dict[str, int] = {}
    alike = defaultdict[tuple[str, ...], list[int]](list)
    for i, one in enumerate(found):
        yield told.setdefault(one.summary, i), i
        alike[_object_names(one.scene)].append(i)
    for rows in alike.values():
        places = np.stack([_positions(found[i].scene) for i in rows])
        for a in range(1, len(rows)):
            offsets = np.linalg.norm(places[:a] - places[a], axis=2).max(axis=1, initial=0.0)
            yield from ((rows[int(b)], rows[a]) for b in np.flatnonzero(offsets <= SAME_SCENE_DISTANCE))


def _object_names(scene: Scene) -> tuple[str, ...]:
    return tuple(sorted(thing.name for thing in scene.objects if thing.role != "person"))


def _positions(scene: Scene) -> np.ndarray:
    """Positions of the things but people in the order of their names, shape (n_things, 3) [m]."""
    things = sorted((thing.name, thing.pose.position) for thing in scene.objects if thing.role != "person")
    return np.array([position for _, position in things], float).reshape(len(things), 3)


def _group_name(oldest: Candidate) -> str:
    return hashlib.sha256(oldest.memory.id.encode()).hexdigest()[:16]


def _hash_fraction(group: str, salt: str) -> float:
    """A number in [0, 1) for `group`."""
    return int(hashlib.sha256(f"{salt}:{group}".encode()).hexdigest()[:13], 16) / 16**13
