"""The front door of memory: recall before an episode, store after it (paper 5)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

from dualbrain.errors import InvalidSetup
from dualbrain.memory.config import MemoryConfig
from dualbrain.memory.embedding.image_features import Picture
from dualbrain.memory.embedding.joint_embedding import Alpha, Embedded, JointEmbedding
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.embedding.text_encoder import Encoder
from dualbrain.memory.index.filters import Filter
from dualbrain.memory.index.index import Index, Ranking
from dualbrain.memory.learning.consolidation import Consolidation
from dualbrain.memory.ledger.events import CONFIRM, EPISODE, ROLLBACK, STATUS_OF, Status, Weighing
from dualbrain.memory.ledger.hash_chain import Event, Head, checked
from dualbrain.memory.ledger.ledger import Entry, Ledger, LedgerReader, Vector
from dualbrain.memory.retrieval.search import Hit
from dualbrain.memory.state.derivation import derive
from dualbrain.memory.state.episode_record import Trace, read_stored, retrieved
from dualbrain.memory.state.snapshot import Snapshot, read, write
from dualbrain.memory.state.state import apply_all
from dualbrain.records import Episode, Exemplar, Recall

SNAPSHOT_AFTER = 2000
"""A start that had to read more events than this leaves a snapshot for the next one."""


@dataclass(frozen=True, slots=True)
class StoreReport:
    """What storing an episode changed: its event in the ledger, the new head of the chain and every weight moved.

    `neighbours` counts those in its neighbourhood. `status` is what the new memory is believed to be, `confirmed` names
    the candidates that its outcome confirmed.
    """

    episode_id: str
    seq: int
    head: Head
    changes: tuple[Weighing, ...]
    neighbours: int = 0
    status: Status = "active"
    confirmed: tuple[str, ...] = ()

    def __str__(self) -> str:
        """One line for a person, such as "weights: e-13 (new) 0.50 -> 0.58, c-12 0.50 -> 0.58"."""
        moves = [f"{c.memory}{'' if c.rank else ' (new)'} {c.before:.2f} -> {c.after:.2f}" for c in self.changes]
        moves += [f"{self.neighbours} neighbours"] if self.neighbours else []
        notes = {
            "candidate": "; not offered before something confirms it",
            "quarantined": "; quarantined, for the robot's own senses disagree",
        }.get(self.status, "")
        confirmed = f"; confirms {', '.join(self.confirmed)}" if self.confirmed else ""
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

    def trace(self, name: str) -> Trace:
        """Texts and contract of one memory, read from the ledger."""
        return read_stored(self.ledger.event(self.state[name].seq).payload).episode

    # --- recall -----------------------------------------------------------------------------------------------------

    def recall(
        self, instruction: str, summary: str, state: Posture | None, robot: str, registry: str, *, k: int,
        image: Picture | None = None, alpha: Alpha | None = None, lambda_s: float | None = None,
        diversity: float | None = None, where: Filter | None = None,
    ) -> Recall:  # fmt: skip
        """The k best successes as exemplars and, apart from them, the best failures as warnings (paper 5.2).

        Only memories of the same robot and the same registry hash are offered: a contract made for other skills, units
        or bounds is no example. `alpha`, `lambda_s` and `diversity` take the place of the configured ones; `where` adds
        conditions. The same ledger and query give the same answer, ties included.
        """
        query = self.embedding.embed(instruction, summary, state, robot, image)
        compared = self.index.compare(query, alpha or self.config.embedding.alpha)
        narrowed = dataclasses.replace(where or Filter(), robot=robot, registry=registry)
        lambda_s = self.config.lambda_s if lambda_s is None else lambda_s
        ranking = Ranking(k, lambda_s, self.config.diversity if diversity is None else diversity)
        few = dataclasses.replace(ranking, k=self.config.warnings)
        follow, avoid = (dataclasses.replace(narrowed, lesson=lesson) for lesson in ("follow", "avoid"))
        weights = self.index.weights(compared, robot, registry, self.config.bandwidth)
        return Recall(
            self._exemplars(query, self.index.hits(compared, weights, follow, ranking)),
            self._exemplars(query, self.index.hits(compared, weights, avoid, few)),
        )

    def _exemplars(self, query: Embedded, hits: Sequence[Hit]) -> tuple[Exemplar, ...]:
        return tuple(
            self.trace(self.state.memos[hit.row].id).exemplar(hit, rank, self.index.parts(hit.row, query))
            for rank, hit in enumerate(hits, start=1)
        )

    # --- store ------------------------------------------------------------------------------------------------------

    def store(self, episode: Episode, state: Posture, *, now: float, image: Picture | None = None) -> StoreReport:
        """Write `episode` and the weight changes it causes, in one transaction, at `now` [s, 1970 UTC].

        `episode.recall` must hold what stood in the prompt. Order: the new memory from w = 0.5 by its own outcome, then
        the exemplars that it followed by rank (never the warnings), then its neighbourhood. A candidate teaches nothing
        until something confirms it. `episode.judgement` is neither read nor written: the ledger is the same whatever
        simulator truth says.
        """
        if any(True for _ in self.ledger.events("kind = ? AND subject = ?", (EPISODE, episode.id))):
            raise InvalidSetup("episode id", got=episode.id, allowed="one that this ledger does not hold yet")
        shown = [str(hit["memory"]) for hit in retrieved(episode.recall)]
        if strangers := [name for name in shown if name not in self.state]:
            raise InvalidSetup("recalled memories", got=strangers, allowed="ids of episodes in this ledger")
        written = self.consolidation().of(episode, state, image, now)
        events = self.append(written.entries, now=now)
        first, head = events[0], Head(events[-1].seq, events[-1].hash)
        w = written
        return StoreReport(first.subject, first.seq, head, w.changes, w.neighbours, w.status, w.confirmed)

    def consolidation(self) -> Consolidation:
        """What works out the events of an outcome, on the present state."""
        return Consolidation(self.ledger, self.state, self.index, self.config)

    def append(self, entries: Sequence[Entry], *, now: float) -> tuple[Event, ...]:
        """Write events, all or none, and bring state and index up to them; raises `InvalidSetup` if only reading."""
        if not isinstance(self.ledger, Ledger):
            raise InvalidSetup("memory", got="a ledger opened for reading", allowed="a ledger opened for writing")
        vectors = [entry.vector for entry in entries]
        events = self.ledger.append(entries, now=now)
        if any(_turns_back(event) for event in events):
            self._derive()
        else:
            known = dict(zip((event.seq for event in events), vectors, strict=True))
            apply_all(events, str(self.ledger.path), lambda event: self._apply(event, known[event.seq]))
        return events

    def _apply(self, event: Event, vector: Vector | None) -> None:
        rows = self.state.apply(event)
        if event.kind == EPISODE:
            self.index.add(self.state.memos[-1], vector)
        else:
            self.index.sync(self.state, rows)

    # --- start ------------------------------------------------------------------------------------------------------

    def _start(self) -> None:
        """From a snapshot that fits and what came after it, or else from the first event."""
        snapshot = read(self.ledger)
        after = snapshot.head if snapshot else None
        where, values = ("seq > ?", (after.seq,)) if after else ("", ())
        tail = list(checked(self.ledger.events(where, values), str(self.ledger.path), after=after))
        if not (snapshot and self._starts_at(snapshot, tail)):
            self._derive()
        if isinstance(self.ledger, Ledger) and len(tail) > SNAPSHOT_AFTER:
            self.leave_snapshot(self.ledger, now=self.ledger.opened)

    def _starts_at(self, snapshot: Snapshot, tail: Sequence[Event]) -> bool:
        """Begin with `snapshot` and apply `tail`; False if it was made otherwise, or something after it turns back."""
        self.state, self.index = snapshot.state, Index(self.embedding)
        if not self.index.fits(snapshot) or any(_turns_back(event) for event in tail):
            return False
        self.index.load(snapshot)
        vectors = dict(self.ledger.vectors(snapshot.head.seq))
        apply_all(tail, str(self.ledger.path), lambda event: self._apply(event, vectors.get(event.seq)))
        return True

    def _derive(self) -> None:
        """State and index from all events in effect."""
        self.state, self.index = derive(self.ledger), Index(self.embedding)
        vectors = dict(self.ledger.vectors())
        for memo in self.state.memos:
            self.index.add(memo, vectors.get(memo.seq))

    def leave_snapshot(self, ledger: Ledger, *, now: float) -> None:
        """Write the present state beside the ledger, for a quick start."""
        head, versions = ledger.head(), self.index.versions(self.state)
        write(ledger, Snapshot(head, versions, self.state, self.index.scan.rows, self.index.scan.masks), now=now)


def _turns_back(event: Event) -> bool:
    """Whether an event changes what earlier events did."""
    return event.kind == ROLLBACK or (event.kind in STATUS_OF and event.kind != CONFIRM)
