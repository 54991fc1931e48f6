"""The interface of the episodic memory: retrieve before an episode, store after it (paper 5)."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from dualbrain.core.encoder import Encoder
from dualbrain.core.storage.atomic_files import FileWriteError
from dualbrain.core.text import count_noun
from dualbrain.errors import DECODE_ERRORS, ConfigurationError, UnknownNameError
from dualbrain.memory.config import MemoryConfig
from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.memory.embedding.joint_embedding import Alpha, EpisodeEmbedding, JointEmbedding
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.index.engine_index import connect_engine, create_index
from dualbrain.memory.index.filters import Filter
from dualbrain.memory.index.index import RankingOptions, RetrievalScope
from dualbrain.memory.learning.consolidation import Consolidation
from dualbrain.memory.learning.precedents import PrecedentSearch
from dualbrain.memory.ledger.events import (
    CONFIRM,
    EPISODE,
    ROLLBACK,
    STATUS_BY_EVENT_KIND,
    VECTORS,
    Status,
    WeightUpdate,
)
from dualbrain.memory.ledger.hash_chain import GENESIS, Head, LedgerEvent, verified_events
from dualbrain.memory.ledger.ledger import Ledger, LedgerReader, PendingEvent, StoredVector
from dualbrain.memory.ledger.shared.spool import WaitingItem
from dualbrain.memory.ledger.store import HeadMovedError, RefusedEntryError, ServerUnreachableError
from dualbrain.memory.retrieval.search import MemoryHit
from dualbrain.memory.state.derivation import derive_state
from dualbrain.memory.state.episode_record import EpisodeRecord, decode_stored_episode, retrieved_memories
from dualbrain.memory.state.snapshot import MemorySnapshot, read_snapshot, write_snapshot
from dualbrain.memory.state.state import MemoryState, apply_events
from dualbrain.records import Episode, Exemplar, Precedent, RetrievedContext

MAX_MISSES = 3
"""Number of times that an outcome is computed while other robots may append; then they wait."""
SNAPSHOT_MIN_EVENTS = 2000
"""After reading more events than this, the memory writes a snapshot for the next start."""
T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class StoreReport:
    """The changes by storing an episode: its event in the ledger, the new head of the chain and all weight updates.

    `n_neighbours` is the number of neighbours whose weights changed, `status` the status of the new memory, and
    `confirmed_ids` the candidates that its outcome confirmed. `is_waiting`: the server of a shared ledger is
    not available for the `waiting_reason`, and the episode waits on this machine; then `seq` is 0, and no weight has
    changed yet.
    """

    episode_id: str
    seq: int
    head: Head
    weight_updates: tuple[WeightUpdate, ...]
    n_neighbours: int = 0
    status: Status = "active"
    confirmed_ids: tuple[str, ...] = ()
    is_waiting: bool = False
    waiting_reason: str = ""

    def __str__(self) -> str:
        """One line for people, such as "weights: e-13 (new) 0.50 -> 0.58, c-12 0.50 -> 0.58"."""
        if self.is_waiting:
            return f"the episode waits on this machine for the server of the shared memory: {self.waiting_reason}"
        moves = [f"{c.memory}{'' if c.rank else ' (new)'} {c.before:.2f} -> {c.after:.2f}" for c in self.weight_updates]
        moves += [count_noun(self.n_neighbours, "neighbour")] if self.n_neighbours else []
        notes = {
            "candidate": "; not retrieved until another outcome confirms it",
            "quarantined": "; quarantined, because a second outcome check disagrees",
        }.get(self.status, "")
        confirmed = f"; confirms {', '.join(self.confirmed_ids)}" if self.confirmed_ids else ""
        return f"weights: {', '.join(moves) or 'unchanged'}{notes}{confirmed}"


class _WaitingEpisode(msgspec.Struct, frozen=True, kw_only=True):
    """The arguments of `Memory.store` that wait for the server of a shared ledger."""

    episode: Episode
    state: Posture
    image: ImageFeatures | None = None


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
        self._engine = connect_engine(ledger, self.embedding.dim)
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
        self.catch_up()
        embedded = self.embedding.embed(instruction, summary, state, robot, image)
        writers = self.ledger.usable_writers
        narrowed = dataclasses.replace(where or Filter(), robot=robot, registry=registry, writers=writers)
        lambda_s = self.config.lambda_s if lambda_s is None else lambda_s
        ranking = RankingOptions(k, lambda_s, self.config.diversity if diversity is None else diversity)
        warning_ranking = dataclasses.replace(ranking, k=self.config.max_warnings)
        follow, avoid = (dataclasses.replace(narrowed, guidance=guidance) for guidance in ("follow", "avoid"))
        scope = RetrievalScope(robot=robot, registry=registry, bandwidth=self.config.bandwidth, writers=writers)
        query = self.index.query(embedded, alpha or self.config.embedding.alpha)
        exemplars, warnings = self.index.retrieve(query, scope, [(follow, ranking), (avoid, warning_ranking)])
        return RetrievedContext(self._exemplars(embedded, exemplars), self._exemplars(embedded, warnings))

    def _exemplars(self, embedded: EpisodeEmbedding, hits: Sequence[MemoryHit]) -> tuple[Exemplar, ...]:
        return tuple(
            self.read_episode(self.state.memories[hit.row].id).to_exemplar(
                hit, rank, self.index.block_cosines(hit.row, embedded)
            )
            for rank, hit in enumerate(hits, start=1)
        )

    def find_precedents(
        self, summary: str, state: Posture | None, robot: str, registry: str, *, max_count: int
    ) -> tuple[Precedent, ...]:
        """At most `max_count` successes in the scenes most similar to this one, of any instruction.

        The arguments are those of `retrieve`.
        """
        self.catch_up()
        embedded = self.embedding.embed("", summary, state, robot)
        return self._precedents(robot, registry).in_similar_scenes(embedded, max_count)

    def find_outcomes(
        self, contract: dict[str, Any], robot: str, registry: str, *, max_count: int
    ) -> tuple[Precedent, ...]:
        """The newest `max_count` outcomes of the actions of `contract` in any scene, newest first."""
        return self._precedents(robot, registry).of_contract(contract, max_count)

    def _precedents(self, robot: str, registry: str) -> PrecedentSearch:
        return PrecedentSearch(self.ledger, self.state, self.index, self.config.plasticity, robot, registry)

    # --- store ------------------------------------------------------------------------------------------------------

    def store(self, episode: Episode, state: Posture, *, now: float, image: ImageFeatures | None = None) -> StoreReport:
        """Write `episode` and the weight updates that it causes, in one transaction, at `now` [s, 1970 UTC].

        `episode.recall` must be the retrieved context in the prompt. Order of the updates: the new memory from w = 0.5,
        then by rank the exemplars that the contract follows (never the warnings), then the neighbourhood. A candidate
        updates no weights until it is confirmed. `episode.judgement` is neither read nor written: the ledger does not
        depend on simulator ground truth. Raises `ConfigurationError` for an id that is in the ledger already, and for
        retrieved memories that are not in it.
        """
        ledger = self._writable_ledger()
        episode = msgspec.structs.replace(episode, id=ledger.qualify(episode.id))
        self.catch_up()
        try:
            return self._store(ledger, episode, state, now=now, image=image)
        except ServerUnreachableError as error:
            waiting = _WaitingEpisode(episode=episode, state=state, image=image)
            heads = () if error.attempted is None else (error.attempted,)
            body = msgspec.Raw(msgspec.json.encode(waiting))
            ledger.spool.add(WaitingItem(time=now, run=ledger.run, episode=body, attempts=heads))
            return StoreReport(
                episode_id=episode.id,
                seq=0,
                head=self._seen,
                weight_updates=(),
                is_waiting=True,
                waiting_reason=error.reason,
            )

    def _store(
        self, ledger: Ledger, episode: Episode, state: Posture, *, now: float, image: ImageFeatures | None
    ) -> StoreReport:
        return self._at_newest(ledger, lambda: self._store_once(episode, state, now=now, image=image))

    def _at_newest(self, ledger: Ledger, attempt: Callable[[], T]) -> T:
        """The result of `attempt`, again if another robot was faster; the last time no other can append."""
        for _ in range(MAX_MISSES):
            try:
                return attempt()
            except HeadMovedError:
                self._receive()
        with ledger.exclusive():
            self._receive()
            return attempt()

    def _store_once(
        self,
        episode: Episode,
        state: Posture,
        *,
        now: float,
        image: ImageFeatures | None,
        run: str | None = None,
        before_commit: Callable[[Head], None] | None = None,
    ) -> StoreReport:
        """Store if the newest event is the one of which this memory has the state, otherwise raise `HeadMovedError`."""
        if any(True for _ in self.ledger.events(EPISODE, subject=episode.id)):
            raise RefusedEntryError.stating(
                f"The ledger already contains an episode {episode.id!r}.", fix="Use a new episode id."
            )
        shown = [str(hit["memory"]) for hit in retrieved_memories(episode.recall)]
        if unknown := [name for name in shown if name not in self.state]:
            raise RefusedEntryError("retrieved memories", got=unknown, allowed="ids of episodes in this ledger")
        transaction = self.consolidation().build_transaction(episode, state, image, now)
        entries = [dataclasses.replace(one, run=run) for one in transaction.events]
        events = self.append(entries, now=now, after=self._seen, before_commit=before_commit)
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

    # --- a shared ledger --------------------------------------------------------------------------------------------

    def catch_up(self) -> int:
        """Apply the events of other robots, and store the episodes that wait for the server of a shared ledger.

        Returns the number of applied events, 0 if the server does not answer or the ledger is not shared. Raises
        `CorruptLedgerError` if the events of the server do not continue the ledger.
        """
        ledger = self.ledger
        if not (isinstance(ledger, Ledger) and ledger.is_shared):
            return 0
        before = self._seen.seq
        if self._receive():
            self._store_waiting(ledger)
        return self._seen.seq - before

    def _receive(self) -> bool:
        answered = isinstance(self.ledger, Ledger) and self.ledger.receive()
        self._follow()
        return answered

    def _follow(self) -> None:
        """Apply the events of the ledger that follow the newest applied one."""
        fresh = list(self.ledger.events(after=self._seen.seq))
        if any(_changes_history(event) or event.kind == VECTORS for event in fresh):
            self._derive_from_events()
        elif fresh:
            vectors = dict(self.ledger.vectors(self._seen.seq))
            apply_events(fresh, str(self.ledger.path), lambda event: self._apply(event, vectors.get(event.seq)))
        if fresh:
            self._seen = Head(fresh[-1].seq, fresh[-1].hash)

    def _store_waiting(self, ledger: Ledger) -> None:
        """Append the waiting items in their order, each once.

        Only an item that the ledger can never take is put away. One that this robot cannot store at present, for
        example because its configuration has no joint limits for the robot of the episode, waits on.
        """
        for file in ledger.spool.files():
            try:
                self._append_file(ledger, file)
            except ServerUnreachableError:
                return
            except (RefusedEntryError, *DECODE_ERRORS) as error:
                kept = ledger.spool.put_away(file)
                _notice(ledger, f"An item that waited for the shared ledger was refused: {error} {kept}")
            except (ConfigurationError, UnknownNameError, FileWriteError) as error:
                _notice(ledger, f"An item still waits for the shared ledger: {error} {file}")
            else:
                ledger.spool.remove(file)

    def _append_file(self, ledger: Ledger, file: Path) -> None:
        """Append the item in `file` after the newest event, unless an earlier attempt had succeeded.

        Each attempt is noted in the file before it is sent: the answer may not arrive, or the process may be killed.
        """
        item = ledger.spool.read(file)

        def note_attempt(first: Head) -> None:
            if first not in item.attempts:
                ledger.spool.replace(file, msgspec.structs.replace(item, attempts=(*item.attempts, first)))

        while not ledger.contains(item.attempts):
            try:
                if item.events:
                    entries = [
                        PendingEvent(
                            kind=one.kind, subject=one.subject, payload=msgspec.json.decode(one.payload), run=one.run
                        )
                        for one in item.events
                    ]
                    self.append(entries, now=item.time, after=self._seen, before_commit=note_attempt)
                else:
                    one = msgspec.json.decode(item.episode, type=_WaitingEpisode)
                    self._store_once(
                        one.episode,
                        one.state,
                        now=item.time,
                        image=one.image,
                        run=item.run,
                        before_commit=note_attempt,
                    )
            except HeadMovedError:
                if not self._receive():
                    raise ServerUnreachableError("it stopped answering") from None
            else:
                return

    # --- append -----------------------------------------------------------------------------------------------------

    def consolidation(self) -> Consolidation:
        """The consolidation that computes the events of an outcome from the present state."""
        return Consolidation(self.ledger, self.state, self.index, self.config)

    def append(
        self,
        entries: Sequence[PendingEvent],
        *,
        now: float,
        after: Head | None = None,
        before_commit: Callable[[Head], None] | None = None,
    ) -> tuple[LedgerEvent, ...]:
        """Append events, all or none, and update state and index.

        `before_commit` is that of `Ledger.append`. Raises `ConfigurationError` if the ledger was opened for reading,
        and `HeadMovedError` if `after` is given and is not the newest event.
        """
        vectors = [entry.vector for entry in entries]
        events = self._writable_ledger().append(entries, now=now, after=after, before_commit=before_commit)
        if events[0].previous != self._seen.hash or any(_changes_history(event) for event in events):
            self._follow()
        else:
            vector_by_seq = dict(zip((event.seq for event in events), vectors, strict=True))
            apply_events(events, str(self.ledger.path), lambda event: self._apply(event, vector_by_seq[event.seq]))
            self._seen = Head(events[-1].seq, events[-1].hash)
        return events

    def append_computed(self, compute: Callable[[], Sequence[PendingEvent]], *, now: float) -> tuple[LedgerEvent, ...]:
        """Append the events that `compute` derives from the newest state, all or none.

        They are computed again if another robot was faster. Raises the errors of `append` and `compute`.
        """
        ledger = self._writable_ledger()
        self._receive()
        return self._at_newest(ledger, lambda: self.append(compute(), now=now, after=self._seen))

    def _writable_ledger(self) -> Ledger:
        if not isinstance(self.ledger, Ledger):
            raise ConfigurationError.stating(
                "This memory is read-only, because its ledger was opened for reading.", fix="Open it as a `Ledger`."
            )
        return self.ledger

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
        newest = tail[-1] if tail else after
        self._seen = Head(newest.seq, newest.hash) if newest else Head(0, GENESIS)
        if isinstance(self.ledger, Ledger) and len(tail) > SNAPSHOT_MIN_EVENTS:
            with suppress(ServerUnreachableError):
                self.write_snapshot(self.ledger, now=self.ledger.opened_at)
        self.catch_up()

    def _load_snapshot(self, snapshot: MemorySnapshot, tail: Sequence[LedgerEvent]) -> bool:
        """Load `snapshot` and apply `tail`; False if its embedding differs, or `tail` changes the history."""
        self.state, self.index = snapshot.state, create_index(self.embedding, self.ledger, self._engine)
        changes = any(_changes_history(event) or event.kind == VECTORS for event in tail)
        if changes or not self.index.is_compatible(snapshot):
            return False
        self.index.load(snapshot)
        vectors = dict(self.ledger.vectors(snapshot.head.seq))
        apply_events(tail, str(self.ledger.path), lambda event: self._apply(event, vectors.get(event.seq)))
        return True

    def _derive_from_events(self) -> None:
        """Derive state and index from all events in effect."""
        self.state = derive_state(self.ledger)
        self.index = create_index(self.embedding, self.ledger, self._engine)
        vectors = self.ledger.vectors()
        try:
            for memo, vector in _with_vectors(self.state.memories, vectors):
                self.index.add(memo, vector)
        finally:
            deque(vectors, maxlen=0)  # checks all of them: a removed vector is reported as such

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
                masks=self.index.masks,
            ),
            now=now,
        )


def _with_vectors(
    memories: Sequence[MemoryState], vectors: Iterator[tuple[int, StoredVector]]
) -> Iterator[tuple[MemoryState, StoredVector | None]]:
    """Each memory with its vector, if it has one; both are in the order of their events."""
    newest = next(vectors, None)
    for memo in memories:
        while newest is not None and newest[0] < memo.seq:
            newest = next(vectors, None)
        yield memo, newest[1] if newest is not None and newest[0] == memo.seq else None


def _changes_history(event: LedgerEvent) -> bool:
    """Whether an event changes the effect of earlier events."""
    return event.kind == ROLLBACK or (event.kind in STATUS_BY_EVENT_KIND and event.kind != CONFIRM)


def _notice(ledger: Ledger, sentence: str) -> None:
    """Add a notice, unless the ledger has it already."""
    if sentence not in ledger.notices:
        ledger.notices += (sentence,)
