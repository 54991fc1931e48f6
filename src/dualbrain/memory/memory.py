"""The interface of the episodic memory: retrieve before an episode, store after it (paper 5)."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from dualbrain.core.encoder import Encoder
from dualbrain.core.text import count_noun
from dualbrain.errors import ConfigurationError
from dualbrain.memory.config import MemoryConfig
from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.memory.embedding.joint_embedding import Alpha, EpisodeEmbedding, JointEmbedding
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.index.filters import Filter
from dualbrain.memory.index.index import Index, RankingOptions
from dualbrain.memory.learning.consolidation import Consolidation
from dualbrain.memory.ledger.events import CONFIRM, EPISODE, ROLLBACK, STATUS_BY_EVENT_KIND, Status, WeightUpdate
from dualbrain.memory.ledger.hash_chain import Head, LedgerEvent, verified_events
from dualbrain.memory.ledger.ledger import Ledger, LedgerReader, PendingEvent, StoredVector
from dualbrain.memory.retrieval.search import MemoryHit
from dualbrain.memory.state.derivation import derive_state
from dualbrain.memory.state.episode_record import EpisodeRecord, decode_stored_episode, retrieved_memories
from dualbrain.memory.state.snapshot import MemorySnapshot, read_snapshot, write_snapshot
from dualbrain.memory.state.state import apply_events
from dualbrain.records import Episode, Exemplar, RetrievedContext

SNAPSHOT_MIN_EVENTS = 2000
"""After reading more events than this, the memory writes a snapshot for the next start."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StoreReport:
    """The changes by storing an episode: its event in the ledger, the new head of the chain and all weight updates.

    `n_neighbours` is the number of neighbours whose weights changed, `status` the status of the new memory, and
    `confirmed_ids` the candidates that its outcome confirmed.
    """

    episode_id: str
    seq: int
    head: Head
    weight_updates: tuple[WeightUpdate, ...]
    n_neighbours: int = 0
    status: Status = "active"
    confirmed_ids: tuple[str, ...] = ()

    def __str__(self) -> str:
        """One line for people, such as "weights: e-13 (new) 0.50 -> 0.58, c-12 0.50 -> 0.58"."""
        moves = [f"{c.memory}{'' if c.rank else ' (new)'} {c.before:.2f} -> {c.after:.2f}" for c in self.weight_updates]
        moves += [count_noun(self.n_neighbours, "neighbour")] if self.n_neighbours else []
        notes = {
            "candidate": "; not retrieved until another outcome confirms it",
            "quarantined": "; quarantined, because a second outcome check disagrees",
        }.get(self.status, "")
        confirmed = f"; confirms {', '.join(self.confirmed_ids)}" if self.confirmed_ids else ""
        return f"weights: {', '.join(moves) or 'unchanged'}{notes}{confirmed}"


class Memory:
    """The episodic memory of one ledger. Weights and index are in RAM and are derived from the events at the start.

    The memory is not a controller (paper 5.4): it returns text and numbers for a prompt, and imports no module that
    moves a robot.
    """

    def __init__(self, ledger: LedgerReader, encoder: Encoder, config: MemoryConfig) -> None:
        """Derive the state from the newest snapshot and the events after it, and check every link that is read.

        Every vector that is used is checked too: those of the snapshot by the digest of its file, those after it by
        their own digests. A memory of a `LedgerReader` can only retrieve. Raises `CorruptLedgerError` if a link is
        broken or a vector was changed, and
        `ConfigurationError` if the vectors were computed by another embedding.
        """
        self.config, self.ledger = config, ledger
        self.embedding = JointEmbedding(encoder, config.limits, config.embedding)
        self._start()

    def __len__(self) -> int:
        return len(self.state)

    def weights(self) -> dict[str, float]:
        """The weight w ∈ [0, 1] of every memory by episode id, oldest first."""
        return self.state.weights()

    def read_episode(self, name: str) -> EpisodeRecord:
        """Texts and contract of one memory, read from the ledger; raises `KeyError` for an unknown id."""
        return decode_stored_episode(self.ledger.event(self.state[name].seq).payload).episode

    # --- retrieve ---------------------------------------------------------------------------------------------------

    def retrieve(
        self,
        instruction: str,
        summary: str,
        state: Posture | None,
        robot: str,
        registry: str,
        *,
        k: int,
        image: ImageFeatures | None = None,
        alpha: Alpha | None = None,
        lambda_s: float | None = None,
        diversity: float | None = None,
        where: Filter | None = None,
    ) -> RetrievedContext:
        """The k best successes as exemplars and, separately, the best failures as warnings (paper 5.2).

        The query is an `instruction` in words, the `summary` of the scene in symbols, the joint `state` (None: unknown,
        its block is not compared), and an `image` of the scene. Only memories of the same `robot` and the same hash
        `registry` of its skills are retrieved: a contract for other skills, units or bounds is not a valid example. At
        most `k` exemplars and `MemoryConfig.max_warnings` warnings are returned, the best one first. `alpha`,
        `lambda_s` and `diversity` (numbers without a unit) override the configuration; `where` adds conditions. The
        same ledger and query give the same result, including the order of ties.

        Raises:
            UnknownNameError: the memory has no joint limits for `robot`.
            ConfigurationError: a setting is out of range, `state` does not fit the robot, or `image` has the features
                of another encoder.
        """
        query = self.embedding.embed(instruction, summary, state, robot, image)
        compared = self.index.compare(query, alpha or self.config.embedding.alpha)
        narrowed = dataclasses.replace(where or Filter(), robot=robot, registry=registry)
        lambda_s = self.config.lambda_s if lambda_s is None else lambda_s
        ranking = RankingOptions(k, lambda_s, self.config.diversity if diversity is None else diversity)
        warning_ranking = dataclasses.replace(ranking, k=self.config.max_warnings)
        follow, avoid = (dataclasses.replace(narrowed, guidance=guidance) for guidance in ("follow", "avoid"))
        weights = self.index.contract_weights(compared, robot, registry, self.config.bandwidth)
        return RetrievedContext(
            self._exemplars(query, self.index.search(compared, weights, follow, ranking)),
            self._exemplars(query, self.index.search(compared, weights, avoid, warning_ranking)),
        )

    def _exemplars(self, query: EpisodeEmbedding, hits: Sequence[MemoryHit]) -> tuple[Exemplar, ...]:
        return tuple(
            self.read_episode(self.state.memories[hit.row].id).to_exemplar(
                hit, rank, self.index.block_cosines(hit.row, query)
            )
            for rank, hit in enumerate(hits, start=1)
        )

    # --- store ------------------------------------------------------------------------------------------------------

    def store(self, episode: Episode, state: Posture, *, now: float, image: ImageFeatures | None = None) -> StoreReport:
        """Write `episode` and the weight updates that it causes, in one transaction, at `now` [s, 1970 UTC].

        `episode.recall` must be the retrieved context in the prompt. Order of the updates: the new memory from w = 0.5,
        then by rank the exemplars that the contract follows (never the warnings), then the neighbourhood. A candidate
        updates no weights until it is confirmed. `episode.judgement` is neither read nor written: the ledger does not
        depend on simulator ground truth. Raises `ConfigurationError` for an id that is in the ledger already, and for
        retrieved memories that are not in it.
        """
        if any(True for _ in self.ledger.events(EPISODE, subject=episode.id)):
            raise ConfigurationError.stating(
                f"The ledger already contains an episode {episode.id!r}.", fix="Use a new episode id."
            )
        shown = [str(hit["memory"]) for hit in retrieved_memories(episode.recall)]
        if unknown := [name for name in shown if name not in self.state]:
            raise ConfigurationError("retrieved memories", got=unknown, allowed="ids of episodes in this ledger")
        transaction = self.consolidation().build_transaction(episode, state, image, now)
        events = self.append(transaction.events, now=now)
        first, head = events[0], Head(events[-1].seq, events[-1].hash)
        return StoreReport(
            episode_id=first.subject,
            seq=first.seq,
            head=head,
            weight_updates=transaction.weight_updates,
            n_neighbours=transaction.n_neighbours,
            status=transaction.status,
            confirmed_ids=transaction.confirmed,
        )

    def consolidation(self) -> Consolidation:
        """The consolidation that computes the events of an outcome from the present state."""
        return Consolidation(self.ledger, self.state, self.index, self.config)

    def append(self, entries: Sequence[PendingEvent], *, now: float) -> tuple[LedgerEvent, ...]:
        """Append events, all or none, and update state and index.

        Raises `ConfigurationError` if the ledger was opened for reading.
        """
        if not isinstance(self.ledger, Ledger):
            raise ConfigurationError.stating(
                "This memory is read-only, because its ledger was opened for reading.", fix="Open it as a `Ledger`."
            )
        vectors = [entry.vector for entry in entries]
        events = self.ledger.append(entries, now=now)
        if any(_changes_history(event) for event in events):
            self._derive_from_events()
        else:
            vector_by_seq = dict(zip((event.seq for event in events), vectors, strict=True))
            apply_events(events, str(self.ledger.path), lambda event: self._apply(event, vector_by_seq[event.seq]))
        return events

    def _apply(self, event: LedgerEvent, vector: StoredVector | None) -> None:
        rows = self.state.apply(event)
        if event.kind == EPISODE:
            self.index.add(self.state.memories[-1], vector)
        else:
            self.index.sync(self.state, rows)

    # --- start ------------------------------------------------------------------------------------------------------

    def _start(self) -> None:
        """Start from a compatible snapshot and the events after it, otherwise from the first event."""
        snapshot = read_snapshot(self.ledger)
        after = snapshot.head if snapshot else None
        following = self.ledger.events(after=after.seq if after else 0)
        tail = list(verified_events(following, str(self.ledger.path), after=after))
        if not (snapshot and self._load_snapshot(snapshot, tail)):
            if after:
                deque(verified_events(self.ledger.events(until=after.seq), str(self.ledger.path)), maxlen=0)
            self._derive_from_events()
        if isinstance(self.ledger, Ledger) and len(tail) > SNAPSHOT_MIN_EVENTS:
            self.write_snapshot(self.ledger, now=self.ledger.opened_at)

    def _load_snapshot(self, snapshot: MemorySnapshot, tail: Sequence[LedgerEvent]) -> bool:
        """Load `snapshot` and apply `tail`; False if its embedding differs, or `tail` changes the history."""
        self.state, self.index = snapshot.state, Index(self.embedding)
        if not self.index.is_compatible(snapshot) or any(_changes_history(event) for event in tail):
            return False
        self.index.load(snapshot)
        vectors = dict(self.ledger.vectors(snapshot.head.seq))
        apply_events(tail, str(self.ledger.path), lambda event: self._apply(event, vectors.get(event.seq)))
        return True

    def _derive_from_events(self) -> None:
        """Derive state and index from all events in effect."""
        self.state, self.index = derive_state(self.ledger), Index(self.embedding)
        vectors = dict(self.ledger.vectors())
        for memo in self.state.memories:
            self.index.add(memo, vectors.get(memo.seq))

    def write_snapshot(self, ledger: Ledger, *, now: float) -> None:
        """Write a snapshot of the present state beside the ledger, for a fast start."""
        head, versions = ledger.head(), self.index.versions(self.state)
        write_snapshot(
            ledger,
            MemorySnapshot(
                head=head,
                versions=versions,
                state=self.state,
                rows=self.index.flat_index.rows,
                masks=self.index.flat_index.masks,
            ),
            now=now,
        )


def _changes_history(event: LedgerEvent) -> bool:
    """Whether an event changes the effect of earlier events."""
    return event.kind == ROLLBACK or (event.kind in STATUS_BY_EVENT_KIND and event.kind != CONFIRM)
