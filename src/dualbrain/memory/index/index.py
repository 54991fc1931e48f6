"""The vectors of all memories with the columns that filters read: a projection of the ledger, rebuilt at will."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from dualbrain.errors import InvalidSetup
from dualbrain.memory.embedding.image_encoder import IMAGE_ENCODER
from dualbrain.memory.embedding.joint_embedding import Alpha, Embedded, JointEmbedding
from dualbrain.memory.index.filters import Columns, Filter
from dualbrain.memory.ledger.events import EPISODE
from dualbrain.memory.ledger.hash_chain import checked
from dualbrain.memory.ledger.ledger import Ledger, LedgerReader, Vector
from dualbrain.memory.retrieval.mmr import diverse
from dualbrain.memory.retrieval.search import Compared, Hit, Query, Scan, Weights, worth
from dualbrain.memory.state.episode_record import read_stored
from dualbrain.memory.state.snapshot import Snapshot
from dualbrain.memory.state.state import Memo, State

ROUNDING = 1e-5
"""A float32 cosine may be this far off."""


@dataclass(frozen=True, slots=True)
class Ranking:
    """How hits are ranked: λ_s, how much likeness among hits costs (`diversity`), and how many are wanted."""

    k: int
    lambda_s: float
    diversity: float = 0.0


class Index:
    """One row a memory, in the order of the state."""

    def __init__(self, embedding: JointEmbedding) -> None:
        """Begin empty."""
        self.embedding = embedding
        self.scan = Scan(embedding.dim)
        self._columns = Columns()

    def add(self, memo: Memo, vector: Vector | None) -> None:
        """Append `memo` with its vector; zeros for robots that this memory does not serve.

        Raises `InvalidSetup` if another embedding made the vector, or none was stored.
        """
        row, mask = np.zeros(self.embedding.dim, np.float32), 0
        if self.embedding.knows(memo.robot):
            version = self.embedding.version(memo.robot)
            if vector is None or vector.version != version or len(vector.data) != 4 * self.embedding.dim:
                raise InvalidSetup(
                    f"embedding of memory {memo.id}", got=vector and vector.version, allowed=version,
                    fix="Use the encoder and settings of before, or make all vectors anew: `dualbrain memory rebuild`.",
                )  # fmt: skip
            row, mask = np.frombuffer(vector.data, "<f4"), vector.mask
        self.scan.add(row, memo.weight, mask)
        self._columns.add(memo)

    def load(self, snapshot: Snapshot) -> None:
        """Take the rows of a snapshot."""
        weights = np.array([memo.weight for memo in snapshot.state.memos])
        self.scan.load(snapshot.rows, weights, snapshot.masks)
        for memo in snapshot.state.memos:
            self._columns.add(memo)

    def fits(self, snapshot: Snapshot) -> bool:
        """Whether this embedding made the rows of `snapshot`."""
        return snapshot.rows.shape[1] == self.embedding.dim and snapshot.versions == self.versions(snapshot.state)

    def versions(self, state: State) -> dict[str, str]:
        """Embedding version of each robot in `state`, "" for one that this memory does not serve."""
        robots = {memo.robot for memo in state.memos}
        known = self.embedding.knows
        return {robot: self.embedding.version(robot) if known(robot) else "" for robot in robots}

    def sync(self, state: State, rows: Sequence[int]) -> None:
        """Bring weight and status of some rows up to `state`."""
        for row in rows:
            self.scan.reweigh(row, state.memos[row].weight)
            self._columns.set_status(row, state.memos[row].status)

    def compare(self, embedded: Embedded, alpha: Alpha) -> Compared:
        """Read every row once, with the blocks weighted by `alpha`."""
        scale = self.embedding.scale(alpha)
        query = Query(embedded.row * scale, embedded.mask, alpha.shares(), scale)
        return self.scan.compare(query)

    def weights(self, compared: Compared, robot: str, registry: str, bandwidth: float) -> Weights:
        """The weight w̄ of each row near the query, shape (n,), from all memories of this robot and registry.

        Memories of one contract within `bandwidth` ℓ of the query count together (see `retrieval.worth`).
        """
        counted = self._columns.mask(Filter(robot, registry))
        return worth(compared, self.scan.weights, self._columns.contracts, counted, bandwidth)

    def hits(self, compared: Compared, weights: Weights, where: Filter, ranking: Ranking) -> tuple[Hit, ...]:
        """The best memories that pass `where`, by similarity and `weights` (n,)."""
        eligible = self._columns.mask(where)
        if ranking.diversity == 0.0:
            return self.scan.top(compared, eligible, ranking.k, ranking.lambda_s, weights)
        return diverse(self.scan, compared, eligible, ranking.k, ranking.lambda_s, ranking.diversity, weights)

    def within(self, compared: Compared, where: Filter, least: float, most: int) -> list[tuple[int, float]]:
        """Rows that pass `where` with cosine at least `least`, at most `most`, the nearest (then the newest) first."""
        rows = np.flatnonzero(self._columns.mask(where) & (compared.cosine >= least))
        if rows.size > most > 0:
            rough = compared.cosine[rows]
            rows = rows[rough >= np.partition(rough, -most)[-most] - ROUNDING]
        cosines = self.scan.cosines(rows, compared.query)
        order = np.lexsort((-rows, -cosines))[:most]
        return [(int(rows[i]), float(cosines[i])) for i in order]

    def parts(self, row: int, embedded: Embedded) -> dict[str, float]:
        """The cosine of each block that a row and a query both have."""
        mask = int(self.scan.masks[row]) & embedded.mask
        return self.embedding.parts(self.scan.rows[row], embedded.row, mask)


def vector_of(embedded: Embedded, version: str) -> Vector:
    """The row as it lies in the ledger."""
    return Vector(version, embedded.row.astype("<f4").tobytes(), embedded.mask)


def rebuild(ledger: Ledger, embedding: JointEmbedding) -> int:
    """Make all vectors anew from the episodes, for a new encoder or other features; the events stay as they are.

    Returns how many were made. Episodes of robots that `embedding` does not know lose theirs until a later rebuild;
    pictures of another image encoder become missing blocks.
    """
    vectors = dict(made(ledger, embedding))
    ledger.replace_vectors(vectors)
    return len(vectors)


def made(ledger: LedgerReader, embedding: JointEmbedding) -> Iterator[tuple[int, Vector]]:
    """Event number and vector of every episode, made anew."""
    for event in checked(ledger.events(), str(ledger.path)):
        if event.kind != EPISODE:
            continue
        stored = read_stored(event.payload)
        told = stored.episode
        if embedding.knows(told.robot):
            image = stored.image if stored.image and stored.image.encoder == IMAGE_ENCODER else None
            embedded = embedding.embed(told.instruction, told.summary, stored.state, told.robot, image)
            yield event.seq, vector_of(embedded, embedding.version(told.robot))
