"""Precedents: remembered contracts with the evidence of their outcomes and the scenes in which they were executed.

The scene of a memory is read from the ledger, to be compared in metres: similarity compares symbols without positions.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from typing import Any

import msgspec

from dualbrain.errors import DECODE_ERRORS
from dualbrain.memory.embedding.joint_embedding import Alpha, EpisodeEmbedding
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.index.filters import Filter
from dualbrain.memory.index.index import Index
from dualbrain.memory.ledger.events import Status
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.plasticity.hebbian_update import Plasticity
from dualbrain.memory.plasticity.plan_similarity import contract_actions
from dualbrain.memory.state.provenance import content_digest
from dualbrain.memory.state.state import LedgerState, MemoryState
from dualbrain.records import Evidence, Precedent, Scene

SCENE_ALPHA = Alpha(instruction=0.0, summary=0.8, symbols=0.0, image=0.0, state=0.2)
"""Weights of the blocks when scenes are compared, not requests; the symbols depend on the objects of a request."""
MIN_COSINE = 0.8
"""Least cosine of scenes that may be the same place. The noise of perception changes some words of a summary: of 560
pairs in the same place, every cosine was at least 0.99."""
COUNTED_STATUSES: tuple[Status, ...] = ("active", "candidate", "quarantined")


class _Episode(msgspec.Struct, frozen=True):
    instruction: str
    summary: str
    contract: dict[str, Any] | None
    scene: Scene


class _StoredPrecedent(msgspec.Struct, frozen=True):
    """The fields of an episode event; `status` is that at the time of storing."""

    episode: _Episode
    state: Posture
    status: Status = "active"


class PrecedentSearch:
    """Reads precedents of a `robot` with a `registry` from a memory; `rule` is None if the weights are frozen."""

    def __init__(
        self, ledger: LedgerReader, state: LedgerState, index: Index, rule: Plasticity | None, robot: str, registry: str
    ) -> None:
        """Search in the present `state` and `index` of a memory."""
        self._ledger, self._state, self._index, self._rule = ledger, state, index, rule
        self._where = Filter(robot=robot, registry=registry, writers=ledger.usable_writers, statuses=COUNTED_STATUSES)

    def in_similar_scenes(self, embedded: EpisodeEmbedding, max_count: int) -> tuple[Precedent, ...]:
        """At most `max_count` successes in the scenes most similar to that of `embedded`, of any instruction."""
        where = replace(self._where, guidance="follow")
        query = self._index.query(embedded, SCENE_ALPHA)
        rows = self._index.find_similar(query, where, MIN_COSINE, max_count)
        return tuple(self._read(self._state.memories[row] for row, _ in rows))

    def of_contract(self, contract: dict[str, Any], max_count: int) -> tuple[Precedent, ...]:
        """The newest `max_count` outcomes of the actions of `contract` in any scene, newest first."""
        digest, where = content_digest(contract_actions(contract)), self._where
        same = (
            memo
            for memo in reversed(self._state.memories)
            if memo.provenance.contract == digest
            and (memo.robot, memo.registry) == (where.robot, where.registry)
            and memo.status in where.statuses
            and memo.guidance != "none"
            and (not where.writers or memo.writer in where.writers)
        )
        return tuple(self._read(islice(same, max_count)))

    def _read(self, memos: Iterator[MemoryState]) -> Iterator[Precedent]:
        """The precedents of `memos`, without those whose scene is of an earlier version of the records."""
        for memo in memos:
            payload = self._ledger.event(memo.seq).payload
            try:
                stored = msgspec.json.decode(payload, type=_StoredPrecedent)
            except DECODE_ERRORS:
                continue
            episode = stored.episode
            yield Precedent(
                episode_id=memo.id,
                instruction=episode.instruction,
                summary=episode.summary,
                contract=episode.contract or {},
                evidence=self._evidence(memo, stored.status),
                Delta=memo.Delta,
                weight=memo.weight,
                scene=episode.scene,
                q=stored.state.q,
            )

    def _evidence(self, memo: MemoryState, first_status: Status) -> Evidence:
        """A candidate that an outcome in another place confirmed later is no evidence of a confirmed success here."""
        if memo.guidance == "avoid" or memo.status == "quarantined":
            return "against"
        if memo.status != "active" or first_status != "active":
            return "unconfirmed"
        is_clean = self._rule is not None and self._rule.is_reinforcing(memo.r, memo.Delta)
        return "clean" if is_clean else "unclean"
