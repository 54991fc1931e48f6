"""The front door of memory: recall before an episode, store after it (paper 5)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

from dualbrain.errors import ConfigurationError
from dualbrain.memory.config import MemoryConfig
from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.memory.embedding.joint_embedding import Alpha, EpisodeEmbedding, JointEmbedding
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.embedding.text_encoder import Encoder
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
"""A start that had to read more events than this leaves a snapshot for the next one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StoreReport:
    """What storing an episode changed: its event in the ledger, the new head of the chain and every weight moved.

    `neighbours` counts those in its neighbourhood. `status` is what the new memory is believed to be, `confirmed` names
    the candidates that its outcome confirmed.
    """

    episode_id: str
    seq: int
    head: Head
    weight_updates: tuple[WeightUpdate, ...]
    n_neighbours: int = 0
    status: Status = "active"
    confirmed_ids: tuple[str, ...] = ()

    def __str__(self) -> str:
        """One line for a person, such as "weights: e-13 (new) 0.50 -> 0.58, c-12 0.50 -> 0.58"."""
        moves = [f"{c.memory}{'' if c.rank else ' (new)'} {c.before:.2f} -> {c.after:.2f}" for c in self.weight_updates]
        moves += [f"{self.n_neighbours} neighbours"] if self.n_neighbours else []
        notes = {
            "candidate": "; not offered before something confirms it",
            "quarantined": "; quarantined, for the robot's own senses disagree",
        }.get(self.status, "")
        confirmed = f"; confirms {', '.join(self.confirmed_ids)}" if self.confirmed_ids else ""
        return f"weights: {', '.join(moves) or 'unchanged'}{notes}{confirmed}"


class Memory:
    """Embodied experience of one ledger. Weights and the index live in RAM and are derived from the events at start.

    Memory is not a controller (paper 5.4): it returns text and numbers for a prompt, and imports nothing that moves.
    """

    def __init__(self, ledger: LedgerReader, encoder: Encoder, config: MemoryConfig) -> None:
        """Derive the state from the newest snapshot and the events after it, checking each link of the chain it reads.

        A `LedgerReader` gives a memory that only recalls. Raises `DamagedLedger` if a link is broken, `InvalidSetup` if
        another embedding made its vectors.
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
        """Texts and contract of one memory, read from the ledger."""
        return decode_stored_episode(self.ledger.event(self.state[name].seq).payload).episode

    # --- recall -----------------------------------------------------------------------------------------------------

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
        """The k best successes as exemplars and, apart from them, the best failures as warnings (paper 5.2).

        Only memories of the same robot and the same registry hash are offered: a contract made for other skills, units
        or bounds is no example. `alpha`, `lambda_s` and `diversity` take the place of the configured ones; `where` adds
        conditions. The same ledger and query give the same answer, ties included.
        """
        query = self.embedding.embed(instruction, summary, state, robot, image)
        compared = self.index.compare(query, alpha or self.config.embedding.alpha)
        narrowed = dataclasses.replace(where or Filter(), robot=robot, registry=registry)
        lambda_s = self.config.lambda_s if lambda_s is None else lambda_s
        ranking = RankingOptions(k, lambda_s, self.config.diversity if diversity is None else diversity)
        few = dataclasses.replace(ranking, k=self.config.max_warnings)
        follow, avoid = (dataclasses.replace(narrowed, guidance=lesson) for lesson in ("follow", "avoid"))
        weights = self.index.contract_weights(compared, robot, registry, self.config.bandwidth)
        return RetrievedContext(
            self._exemplars(query, self.index.search(compared, weights, follow, ranking)),
            self._exemplars(query, self.index.search(compared, weights, avoid, few)),
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
        """Write `episode` and the weight changes it causes, in one transaction, at `now` [s, 1970 UTC].

        `episode.recall` must hold what stood in the prompt. Order: the new memory from w = 0.5 by its own outcome, then
        the exemplars that it followed by rank (never the warnings), then its neighbourhood. A candidate teaches nothing
        until something confirms it. `episode.judgement` is neither read nor written: the ledger is the same whatever
        simulator truth says.
        """
        if any(True for _ in self.ledger.events("kind = ? AND subject = ?", (EPISODE, episode.id))):
            raise ConfigurationError("episode id", got=episode.id, allowed="one that this ledger does not hold yet")
        shown = [str(hit["memory"]) for hit in retrieved_memories(episode.recall)]
        if strangers := [name for name in shown if name not in self.state]:
            raise ConfigurationError("recalled memories", got=strangers, allowed="ids of episodes in this ledger")
        written = self.consolidation().build_transaction(episode, state, image, now)
        events = self.append(written.events, now=now)
        first, head = events[0], Head(events[-1].seq, events[-1].hash)
        w = written
        return StoreReport(
            episode_id=first.subject,
            seq=first.seq,
            head=head,
            weight_updates=w.weight_updates,
            n_neighbours=w.n_neighbours,
            status=w.status,
            confirmed_ids=w.confirmed,
        )

    def consolidation(self) -> Consolidation:
        """What works out the events of an outcome, on the present state."""
        return Consolidation(self.ledger, self.state, self.index, self.config)

    def append(self, entries: Sequence[PendingEvent], *, now: float) -> tuple[LedgerEvent, ...]:
        """Write events, all or none, and bring state and index up to them; raises `InvalidSetup` if only reading."""
        if not isinstance(self.ledger, Ledger):
            raise ConfigurationError("memory", got="a ledger opened for reading", allowed="a ledger opened for writing")
        vectors = [entry.vector for entry in entries]
        events = self.ledger.append(entries, now=now)
        if any(_changes_history(event) for event in events):
            self._derive_from_events()
        else:
            known = dict(zip((event.seq for event in events), vectors, strict=True))
            apply_events(events, str(self.ledger.path), lambda event: self._apply(event, known[event.seq]))
        return events

    def _apply(self, event: LedgerEvent, vector: StoredVector | None) -> None:
        rows = self.state.apply(event)
        if event.kind == EPISODE:
            self.index.add(self.state.memories[-1], vector)
        else:
            self.index.sync(self.state, rows)

    # --- start ------------------------------------------------------------------------------------------------------

    def _start(self) -> None:
        """From a snapshot that fits and what came after it, or else from the first event."""
        snapshot = read_snapshot(self.ledger)
        after = snapshot.head if snapshot else None
        where, values = ("seq > ?", (after.seq,)) if after else ("", ())
        tail = list(verified_events(self.ledger.events(where, values), str(self.ledger.path), after=after))
        if not (snapshot and self._load_snapshot(snapshot, tail)):
            self._derive_from_events()
        if isinstance(self.ledger, Ledger) and len(tail) > SNAPSHOT_MIN_EVENTS:
            self.write_snapshot(self.ledger, now=self.ledger.opened_at)

    def _load_snapshot(self, snapshot: MemorySnapshot, tail: Sequence[LedgerEvent]) -> bool:
        """Begin with `snapshot` and apply `tail`; False if it was made otherwise, or something after it turns back."""
        self.state, self.index = snapshot.state, Index(self.embedding)
        if not self.index.is_compatible(snapshot) or any(_changes_history(event) for event in tail):
            return False
        self.index.load(snapshot)
        vectors = dict(self.ledger.vectors(snapshot.head.seq))
        apply_events(tail, str(self.ledger.path), lambda event: self._apply(event, vectors.get(event.seq)))
        return True

    def _derive_from_events(self) -> None:
        """State and index from all events in effect."""
        self.state, self.index = derive_state(self.ledger), Index(self.embedding)
        vectors = dict(self.ledger.vectors())
        for memo in self.state.memories:
            self.index.add(memo, vectors.get(memo.seq))

    def write_snapshot(self, ledger: Ledger, *, now: float) -> None:
        """Write the present state beside the ledger, for a quick start."""
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
    """Whether an event changes what earlier events did."""
    return event.kind == ROLLBACK or (event.kind in STATUS_BY_EVENT_KIND and event.kind != CONFIRM)
