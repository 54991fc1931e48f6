"""What storing one episode writes: the episode, what its outcome teaches, and which candidates it confirms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from dualbrain.memory.config import MemoryConfig
from dualbrain.memory.embedding.image_features import Picture
from dualbrain.memory.embedding.joint_embedding import Embedded
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.index.filters import Filter
from dualbrain.memory.index.index import Index, vector_of
from dualbrain.memory.learning.weight_updates import Lecture, Teacher
from dualbrain.memory.ledger.events import (
    CONFIRM,
    EPISODE,
    NEIGHBOURS,
    WEIGHT,
    Neighbourhood,
    Status,
    StatusChange,
    Weighing,
)
from dualbrain.memory.ledger.ledger import Entry, LedgerReader
from dualbrain.memory.plasticity.plan_similarity import departure, same_plan
from dualbrain.memory.plasticity.rule import W0
from dualbrain.memory.state.episode_record import LESSONS, payload, read_shown, read_stored, shown
from dualbrain.memory.state.provenance import provenance_of
from dualbrain.memory.state.state import Memo, State
from dualbrain.records import Episode, OutcomeClass

CANDIDATES = 20
"""How many candidates one outcome is compared with, the nearest first."""
BY_OUTCOME, BY_PERSON = "a later consistent outcome", "a person"


@dataclass(frozen=True, slots=True)
class Written:
    """The events to append, the status of the new memory, every weight it moves, and the candidates it confirms."""

    entries: tuple[Entry, ...]
    status: Status
    changes: tuple[Weighing, ...]
    neighbours: int
    confirmed: tuple[str, ...]


class Consolidation:
    """Works out events; writes nothing itself."""

    def __init__(self, ledger: LedgerReader, state: State, index: Index, config: MemoryConfig) -> None:
        """Read from these."""
        self._ledger, self._state, self._index, self._config = ledger, state, index, config

    def of(self, episode: Episode, posture: Posture, image: Picture | None, now: float) -> Written:
        """Everything that storing `episode` at `now` [s, 1970 UTC] writes, in its order."""
        trust, source = self._config.trust, provenance_of(episode).source
        version = self._index.embedding.version(episode.robot)
        embedded = self._index.embedding.embed(episode.instruction, episode.summary, posture, episode.robot, image)
        status = trust.status(episode)
        confirmed = self._confirmed_by(episode, embedded, status, source)
        status = "active" if status == "candidate" and confirmed else status
        body = payload(episode, posture, image, version, self._config.plasticity, status)
        entries = [Entry(EPISODE, episode.id, body, vector_of(embedded, version))]
        teacher = self._teacher(now)
        changes, around = list[Weighing](), 0
        if teacher and status == "active" and LESSONS[episode.outcome.kind] != "none":
            teacher.welcome(episode.id, W0)
            r, Delta = episode.outcome.r, _executed(episode.outcome.kind, episode.outcome.Delta)
            followed = self._followed(episode.contract, shown(episode.recall))
            lecture = Lecture(episode.id, source, r, Delta, followed, self._around(embedded, episode))
            changes, neighbours = teacher.teach(lecture)
            entries += _entries(changes, neighbours)
            around = len(neighbours.memories) if neighbours else 0
        if confirmed:
            names = tuple(memo.id for memo in confirmed)
            entries.append(Entry(CONFIRM, "", StatusChange(names, BY_OUTCOME, episode.id)))
            entries += self.belated(confirmed, teacher)
        return Written(tuple(entries), status, tuple(changes), around, tuple(memo.id for memo in confirmed))

    def belated(self, memos: Sequence[Memo], teacher: Teacher | None) -> list[Entry]:
        """What the outcomes of `memos` teach now that they are believed, oldest first."""
        return [entry for memo in memos if teacher for entry in _entries(*teacher.teach(self._lecture(memo)))]

    def taught_late(self, names: Sequence[str], now: float) -> list[Entry]:
        """The same for memories that a person releases; those that have taught before are passed over."""
        memos = [self._state[name] for name in names]
        waiting = [memo for memo in memos if memo.lesson != "none" and not self._has_taught(memo)]
        return self.belated(waiting, self._teacher(now))

    def _has_taught(self, memo: Memo) -> bool:
        own = self._ledger.events("kind = ? AND subject = ?", (WEIGHT, memo.id))
        return any(msgspec.json.decode(event.payload, type=Weighing).cause == memo.id for event in own)

    def _teacher(self, now: float) -> Teacher | None:
        rule = self._config.plasticity
        return None if rule is None else Teacher(self._state, rule, self._config.trust, now)

    def _confirmed_by(self, episode: Episode, embedded: Embedded, status: Status, source: str) -> list[Memo]:
        """Candidates that `episode` confirms, because the same plan succeeded again in a like situation.

        The new outcome must be believed, or at least come from another source: many claims of one source do not confirm
        each other.
        """
        if episode.outcome.kind != "succeeded" or status == "quarantined":
            return []
        where = Filter(episode.robot, episode.registry, "follow", statuses=("candidate",))
        compared = self._index.compare(embedded, self._config.embedding.alpha)
        near = [
            self._state.memos[row]
            for row, _ in self._index.within(compared, where, self._config.trust.alike, CANDIDATES)
        ]
        apart = [memo for memo in near if status == "active" or memo.provenance.source != source]
        alike = [memo for memo in apart if same_plan(self._contract(memo), episode.contract)]
        return sorted(alike, key=lambda memo: memo.seq)

    def _contract(self, memo: Memo) -> dict[str, Any] | None:
        return read_stored(self._ledger.event(memo.seq).payload).episode.contract

    def _lecture(self, memo: Memo) -> Lecture:
        data, row = self._ledger.event(memo.seq).payload, self._state.rows[memo.id]
        followed = self._followed(self._contract(memo), read_shown(data))
        embedded = Embedded(self._index.scan.rows[row], int(self._index.scan.masks[row]))
        around = self._around(embedded, memo)
        Delta = _executed(memo.kind, memo.Delta)
        return Lecture(memo.id, memo.provenance.source, memo.r, Delta, followed, around)

    def _followed(self, contract: dict[str, Any] | None, prompt: Sequence[str]) -> list[tuple[int, str]]:
        """Rank and id of the exemplars in `prompt` that `contract` departs from least; none if its skills are others.

        What became of a contract says nothing of another one that stood beside the one it follows.
        """
        gaps = {
            (rank, name): departure(self._contract(self._state[name]), contract)
            for rank, name in enumerate(prompt, start=1) if name in self._state
        }  # fmt: skip
        least = min((gap for gap in gaps.values() if gap is not None), default=None)
        return [place for place, gap in gaps.items() if gap is not None and gap == least]

    def _around(self, embedded: Embedded, one: Episode | Memo) -> list[tuple[str, float]]:
        """Id and squared distance 2 − 2 cos of the neighbours of `one`, itself excluded, nearest first.

        Neighbours hold the same contract: how it went says nothing of others in the same place.
        """
        rule, origin = self._config.plasticity, one.provenance if isinstance(one, Memo) else provenance_of(one)
        if rule is None or rule.kappa == 0.0 or rule.reach == 0 or not origin.skills:
            return []
        where = Filter(one.robot, one.registry, contract=origin.contract, statuses=("active", "candidate"))
        compared = self._index.compare(embedded, self._config.embedding.alpha)
        found = self._index.within(compared, where, 1.0 - rule.radius / 2.0, rule.reach + 1)
        names = [(self._state.memos[row].id, max(0.0, 2.0 - 2.0 * cosine)) for row, cosine in found]
        return [(name, distance) for name, distance in names if name != one.id][: rule.reach]


def _executed(kind: OutcomeClass, Delta: float | None) -> float | None:
    """Δ of an outcome; None for a contract that was refused, for nothing was executed."""
    return None if kind == "rejected" or Delta is None or not np.isfinite(Delta) else Delta


def _entries(weighings: Sequence[Weighing], around: Neighbourhood | None) -> list[Entry]:
    entries = [Entry(WEIGHT, one.memory, one) for one in weighings]
    return entries + ([Entry(NEIGHBOURS, around.cause, around)] if around else [])
