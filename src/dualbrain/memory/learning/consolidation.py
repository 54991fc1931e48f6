"""The events that storing one episode writes: the episode, its weight updates, and the candidates it confirms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dualbrain.memory.config import MemoryConfig
from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.memory.embedding.joint_embedding import EpisodeEmbedding
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.index.filters import Filter
from dualbrain.memory.index.index import Index, to_stored_vector
from dualbrain.memory.learning.weight_updates import OutcomeEvidence, WeightUpdater
from dualbrain.memory.ledger.events import (
    CONFIRM,
    EPISODE,
    NEIGHBOURS,
    WEIGHT,
    NeighbourUpdates,
    Status,
    StatusChange,
    WeightUpdate,
)
from dualbrain.memory.ledger.ledger import LedgerReader, PendingEvent
from dualbrain.memory.plasticity.hebbian_update import W0
from dualbrain.memory.plasticity.plan_similarity import count_differences, same_plan
from dualbrain.memory.state.derivation import counted_outcomes
from dualbrain.memory.state.episode_record import (
    GUIDANCE_BY_OUTCOME,
    decode_shown_exemplar_ids,
    decode_stored_episode,
    episode_payload,
    shown_exemplar_ids,
)
from dualbrain.memory.state.provenance import episode_provenance
from dualbrain.memory.state.state import LedgerState, MemoryState
from dualbrain.records import Episode, OutcomeClass

MAX_CANDIDATES = 20
"""Number of candidates that one outcome is compared with, the nearest first."""
CONFIRMATION_REASON, PERSON_ACTOR = "a later consistent outcome", "a person"


@dataclass(frozen=True, slots=True, kw_only=True)
class StoreTransaction:
    """The events to append, the status of the new memory, all weight updates, and the candidates that it confirms.

    `n_neighbours` is the number of memories in the neighbourhood whose weights change.
    """

    events: tuple[PendingEvent, ...]
    status: Status
    weight_updates: tuple[WeightUpdate, ...]
    n_neighbours: int
    confirmed: tuple[str, ...]


class Consolidation:
    """Computes the events of an outcome; writes nothing itself."""

    def __init__(self, ledger: LedgerReader, state: LedgerState, index: Index, config: MemoryConfig) -> None:
        """Create a consolidation that reads from `ledger`, `state` and `index`."""
        self._ledger, self._state, self._index, self._config = ledger, state, index, config

    def build_transaction(
        self, episode: Episode, posture: Posture, image: ImageFeatures | None, now: float
    ) -> StoreTransaction:
        """All events that storing `episode` at `now` [s, 1970 UTC] writes, in their order."""
        trust, source = self._config.trust, episode_provenance(episode).source
        version = self._index.embedding.version(episode.robot)
        embedded = self._index.embedding.embed(episode.instruction, episode.summary, posture, episode.robot, image)
        status = trust.initial_status(episode)
        confirmed = self._find_confirmed(episode, embedded, status)
        body = episode_payload(episode, posture, image, version, self._config.plasticity, status)
        events = [
            PendingEvent(kind=EPISODE, subject=episode.id, payload=body, vector=to_stored_vector(embedded, version))
        ]
        updater = self._weight_updater(now)
        updates, n_neighbours = list[WeightUpdate](), 0
        if updater and status == "active" and GUIDANCE_BY_OUTCOME[episode.outcome.kind] != "none":
            updater.add_memory(episode.id, W0)
            r, Delta = episode.outcome.r, _executed_intervention(episode.outcome.kind, episode.outcome.Delta)
            followed = self._find_followed(episode.contract, shown_exemplar_ids(episode.recall))
            evidence = OutcomeEvidence(
                cause=episode.id,
                source=source,
                r=r,
                Delta=Delta,
                followed=followed,
                neighbours=self._find_neighbours(embedded, episode),
            )
            updates, neighbours = updater.update(evidence)
            events += _weight_events(updates, neighbours)
            n_neighbours = len(neighbours.memories) if neighbours else 0
        if confirmed:
            names = tuple(memo.id for memo in confirmed)
            events.append(
                PendingEvent(kind=CONFIRM, subject="", payload=StatusChange(names, CONFIRMATION_REASON, episode.id))
            )
            events += self.confirmed_updates(confirmed, updater)
        return StoreTransaction(
            events=tuple(events),
            status=status,
            weight_updates=tuple(updates),
            n_neighbours=n_neighbours,
            confirmed=tuple(memo.id for memo in confirmed),
        )

    def confirmed_updates(self, memos: Sequence[MemoryState], updater: WeightUpdater | None) -> list[PendingEvent]:
        """The weight events of the outcomes of `memos`, which are now trusted; in the order of `memos`."""
        return [event for memo in memos if updater for event in _weight_events(*updater.update(self._evidence(memo)))]

    def released_updates(self, names: Sequence[str], now: float) -> list[PendingEvent]:
        """The weight events of memories that a person releases, without those whose outcomes have been counted.

        The state is the one after the release.
        """
        counted = counted_outcomes(self._ledger)
        memos = [self._state[name] for name in names if name not in counted]
        waiting = [memo for memo in memos if memo.guidance != "none"]
        return self.confirmed_updates(waiting, self._weight_updater(now))

    def _weight_updater(self, now: float) -> WeightUpdater | None:
        rule = self._config.plasticity
        return None if rule is None else WeightUpdater(self._state, rule, self._config.trust, now)

    def _find_confirmed(self, episode: Episode, embedded: EpisodeEmbedding, status: Status) -> list[MemoryState]:
        """Candidates that `episode` confirms, because the same plan succeeded again in a similar situation.

        The new outcome itself must be confirmed by the independent senses. Unconfirmed outcomes do not confirm each
        other, even from several sources: the same wrong verdict on the same plan would repeat itself.
        """
        if episode.outcome.kind != "succeeded" or status != "active":
            return []
        where = Filter(robot=episode.robot, registry=episode.registry, guidance="follow", statuses=("candidate",))
        query = self._index.query(embedded, self._config.embedding.alpha)
        near = [
            self._state.memories[row]
            for row, _ in self._index.find_similar(query, where, self._config.trust.min_similarity, MAX_CANDIDATES)
        ]
        same = [memo for memo in near if same_plan(self._contract(memo), episode.contract)]
        return sorted(same, key=lambda memo: memo.seq)

    def _contract(self, memo: MemoryState) -> dict[str, Any] | None:
        return decode_stored_episode(self._ledger.event(memo.seq).payload).episode.contract

    def _evidence(self, memo: MemoryState) -> OutcomeEvidence:
        data, row = self._ledger.event(memo.seq).payload, self._state.rows[memo.id]
        followed = self._find_followed(self._contract(memo), decode_shown_exemplar_ids(data))
        neighbours = self._find_neighbours(self._index.embedding_of(row), memo)
        Delta = _executed_intervention(memo.kind, memo.Delta)
        return OutcomeEvidence(
            cause=memo.id,
            source=memo.provenance.source,
            r=memo.r,
            Delta=Delta,
            followed=followed,
            neighbours=neighbours,
        )

    def _find_followed(self, contract: dict[str, Any] | None, prompt: Sequence[str]) -> list[tuple[int, str]]:
        """Rank and id of the exemplars in `prompt` that `contract` follows: those with the fewest differences.

        Exemplars with other skills are never followed. The outcome of a contract is no evidence for the other exemplars
        that were in the prompt.
        """
        gaps = {
            (rank, name): count_differences(self._contract(self._state[name]), contract)
            for rank, name in enumerate(prompt, start=1)
            if name in self._state
        }
        least = min((gap for gap in gaps.values() if gap is not None), default=None)
        return [place for place, gap in gaps.items() if gap is not None and gap == least]

    def _find_neighbours(self, embedded: EpisodeEmbedding, one: Episode | MemoryState) -> list[tuple[str, float]]:
        """Id and squared distance 2 − 2 cos of the neighbours of `one`, itself excluded, nearest first.

        Neighbours have the same contract, because an outcome is no evidence for other contracts in the same situation.
        """
        rule = self._config.plasticity
        provenance = one.provenance if isinstance(one, MemoryState) else episode_provenance(one)
        if rule is None or rule.kappa == 0.0 or rule.reach == 0 or not provenance.skills:
            return []
        where = Filter(
            robot=one.robot, registry=one.registry, contract=provenance.contract, statuses=("active", "candidate")
        )
        query = self._index.query(embedded, self._config.embedding.alpha)
        found = self._index.find_similar(query, where, 1.0 - rule.radius / 2.0, rule.reach + 1)
        names = [(self._state.memories[row].id, max(0.0, 2.0 - 2.0 * cosine)) for row, cosine in found]
        return [(name, distance) for name, distance in names if name != one.id][: rule.reach]


def _executed_intervention(kind: OutcomeClass, Delta: float | None) -> float | None:
    """Δ of an outcome; None for a contract that was rejected, because nothing was executed."""
    return None if kind == "rejected" or Delta is None or not np.isfinite(Delta) else Delta


def _weight_events(updates: Sequence[WeightUpdate], neighbours: NeighbourUpdates | None) -> list[PendingEvent]:
    events = [PendingEvent(kind=WEIGHT, subject=update.memory, payload=update) for update in updates]
    if neighbours:
        events.append(PendingEvent(kind=NEIGHBOURS, subject=neighbours.cause, payload=neighbours))
    return events
