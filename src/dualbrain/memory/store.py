"""The front door of memory: recall before an episode, store after it (paper 5)."""

from __future__ import annotations

from dataclasses import dataclass, field

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import InvalidSetup
from dualbrain.memory.chain import DamagedLedger, Head, checked
from dualbrain.memory.embedding import EmbeddingConfig, JointEmbedding
from dualbrain.memory.encoder import Encoder, Rows
from dualbrain.memory.ledger import EPISODE, WEIGHT, Entry, Ledger, Vector
from dualbrain.memory.plasticity import W0, Factors, Plasticity
from dualbrain.memory.posture import Posture, PostureLimits
from dualbrain.memory.retrieval import Compared, Scan, check_lambda
from dualbrain.memory.trace import (
    LESSONS,
    Lesson,
    Trace,
    Weighing,
    payload,
    read_episode,
    read_weighing,
    retrieved,
)
from dualbrain.records import Episode, Exemplar, Recall


@dataclass(frozen=True, slots=True)
class MemoryConfig:
    """`limits` of every robot that uses this memory; the dial is `lambda_s`: 1 trusts likeness, 0 trusts experience.

    A weight gap of 1 outweighs a likeness gap of (1 − λ_s)/λ_s: 0.25 at the default 0.8. `warnings` is how many
    failures are recalled beside the exemplars. `plasticity` None freezes all weights (static retrieval).
    """

    limits: tuple[PostureLimits, ...]
    lambda_s: float = 0.8
    warnings: int = 2
    plasticity: Plasticity | None = field(default_factory=Plasticity)
    embedding: EmbeddingConfig = field(default_factory=EmbeddingConfig)

    def __post_init__(self) -> None:
        """Raise `InvalidSetup` for λ_s outside [0, 1]."""
        check_lambda(self.lambda_s)


@dataclass(frozen=True, slots=True)
class StoreReport:
    """What storing an episode changed: its event in the ledger, the new head of the chain and every weight moved."""

    episode_id: str
    seq: int
    head: Head
    changes: tuple[Weighing, ...]

    def __str__(self) -> str:
        """One line for a person, such as "weights: e-13 (new) 0.50 -> 0.58, c-12 0.50 -> 0.58"."""
        if not self.changes:
            return "weights: unchanged"
        moves = (f"{c.memory}{'' if c.rank else ' (new)'} {c.before:.2f} -> {c.after:.2f}" for c in self.changes)
        return "weights: " + ", ".join(moves)


class Memory:
    """Embodied experience of one ledger. Weights and the index live in RAM and are replayed from the events at start.

    Memory is not a controller (paper 5.4): it returns text and numbers for a prompt, and imports nothing that moves.
    """

    def __init__(self, ledger: Ledger, encoder: Encoder, config: MemoryConfig) -> None:
        """Replay the whole ledger, checking each link of its chain.

        Raises `DamagedLedger` if a link is broken, and `InvalidSetup` if its vectors were made by another embedding.
        """
        self.config = config
        self._ledger = ledger
        self._embedding = JointEmbedding(encoder, config.limits, config.embedding)
        self._scan = Scan(self._embedding.dim)
        self._traces: list[Trace] = []
        self._rows: dict[str, int] = {}
        self._partitions: dict[tuple[str, str, Lesson], int] = {}
        self._members: NDArray[np.int32] = np.empty(64, np.int32)
        self._replay()

    def __len__(self) -> int:
        return len(self._traces)

    def weights(self) -> dict[str, float]:
        """The weight w ∈ [0, 1] of every memory by episode id, oldest first."""
        return {trace.id: self._scan.weight(row) for row, trace in enumerate(self._traces)}

    def recall(self, instruction: str, summary: str, state: Posture, robot: str, registry: str, *, k: int) -> Recall:
        """The k best successes as exemplars and, apart from them, the best failures as warnings (paper 5.2).

        Only memories of the same robot and the same registry hash are offered: a contract made for other skills, units
        or bounds is no example. The same ledger and query give the same answer, ties included.
        """
        query = self._scan.compare(self._embedding.embed(instruction, summary, state, robot))
        follow = self._hits(query, (robot, registry, "follow"), k)
        return Recall(follow, self._hits(query, (robot, registry, "avoid"), self.config.warnings))

    def _hits(self, query: Compared, partition: tuple[str, str, Lesson], k: int) -> tuple[Exemplar, ...]:
        eligible = self._members[: len(self)] == self._partitions.get(partition, -1)
        hits = self._scan.top(query, eligible, k, self.config.lambda_s)
        return tuple(
            self._traces[hit.row].exemplar(similarity=hit.similarity, weight=hit.weight, score=hit.score, rank=rank)
            for rank, hit in enumerate(hits, start=1)
        )

    def store(self, episode: Episode, state: Posture, *, now: float) -> StoreReport:
        """Write `episode` and the weight changes it causes, in one transaction, at `now` [s, 1970 UTC].

        `episode.recall` must hold what stood in the prompt. Order: the new memory from w = 0.5 by its own outcome, then
        those in the prompt by rank (exemplars, then warnings), each by the same outcome. `episode.judgement` is neither
        read nor written: the ledger is the same whatever simulator truth says.
        """
        if episode.id in self._rows:
            raise InvalidSetup("episode id", got=episode.id, allowed="one that this ledger does not hold yet")
        vector = self._embedding.embed(episode.instruction, episode.summary, state, episode.robot)
        version = self._embedding.version(episode.robot)
        body = payload(episode, state, version, self.config.plasticity)
        changes = self._changes(episode)
        entries = [
            Entry(EPISODE, episode.id, body, Vector(version, vector.astype("<f4").tobytes())),
            *(Entry(WEIGHT, change.memory, change) for change in changes),
        ]
        events = self._ledger.append(entries, now=now)
        trace, _, w0 = read_episode(events[0].payload)
        self._remember(trace, w0, vector)
        for event in events[1:]:
            self._weigh(read_weighing(event.payload))
        return StoreReport(episode.id, events[0].seq, Head(events[-1].seq, events[-1].hash), changes)

    def _changes(self, episode: Episode) -> tuple[Weighing, ...]:
        """The weight updates by this outcome, in order; none if it says nothing of the contract (see `LESSONS`)."""
        rule, outcome = self.config.plasticity, episode.outcome
        shown = [str(hit["memory"]) for hit in retrieved(episode.recall)]
        if strangers := [name for name in shown if name not in self._rows]:
            raise InvalidSetup("recalled memories", got=strangers, allowed="ids of episodes in this ledger")
        if rule is None or LESSONS[outcome.kind] == "none":
            return ()
        Delta = None if outcome.kind == "rejected" else outcome.Delta
        factors = rule.factors(outcome.r, Delta)
        word = "reinforce" if rule.reinforces(outcome.r, Delta) else "suppress"
        before = [W0, *(self._scan.weight(self._rows[name]) for name in shown)]
        return tuple(
            Weighing(episode.id, name, word, rank, factors.gain, factors.offset, w, factors(w))
            for rank, (name, w) in enumerate(zip((episode.id, *shown), before, strict=True))
        )

    def _replay(self) -> None:
        vectors = self._ledger.vectors()
        for event in checked(self._ledger.events(), str(self._ledger.path)):
            try:
                if event.kind == EPISODE:
                    trace, _, w0 = read_episode(event.payload)
                    self._remember(trace, w0, self._vector(trace, vectors.get(event.seq)))
                elif event.kind == WEIGHT:
                    self._weigh(read_weighing(event.payload))
            except (msgspec.DecodeError, KeyError) as error:
                raise DamagedLedger(f"unreadable: {error}", seq=event.seq, path=str(self._ledger.path)) from error

    def _vector(self, trace: Trace, stored: Vector | None) -> Rows:
        """The stored vector, if this embedding made it; zeros for robots that this memory does not serve."""
        if not self._embedding.knows(trace.robot):
            return np.zeros(self._embedding.dim, np.float32)
        version = self._embedding.version(trace.robot)
        if stored is None or stored.version != version or len(stored.data) != 4 * self._embedding.dim:
            raise InvalidSetup(
                f"embedding of memory {trace.id}",
                got=stored and stored.version,
                allowed=version,
                fix="Use the encoder and settings of before, or make all vectors anew (memory.store.rebuild).",
            )
        return np.frombuffer(stored.data, "<f4").astype(np.float32)

    def _remember(self, trace: Trace, w0: float, vector: Rows) -> None:
        row = self._scan.add(vector, w0)
        self._rows[trace.id] = row
        self._traces.append(trace)
        if row == len(self._members):
            self._members = np.concatenate([self._members, np.empty_like(self._members)])
        self._members[row] = self._partitions.setdefault(trace.partition, len(self._partitions))

    def _weigh(self, change: Weighing) -> None:
        row = self._rows[change.memory]
        self._scan.reweigh(row, Factors(change.gain, change.offset)(self._scan.weight(row)))


def rebuild(ledger: Ledger, encoder: Encoder, config: MemoryConfig) -> int:
    """Make all vectors anew from the episodes, for a new encoder or new weights; events and weights stay as they are.

    Returns how many were made. Episodes of robots without limits in `config` lose theirs until a later rebuild.
    """
    embedding = JointEmbedding(encoder, config.limits, config.embedding)
    vectors = dict[int, Vector]()
    for event in checked(ledger.events(), str(ledger.path)):
        if event.kind != EPISODE:
            continue
        trace, state, _ = read_episode(event.payload)
        if embedding.knows(trace.robot):
            row = embedding.embed(trace.instruction, trace.summary, state, trace.robot)
            vectors[event.seq] = Vector(embedding.version(trace.robot), row.astype("<f4").tobytes())
    ledger.replace_vectors(vectors)
    return len(vectors)
