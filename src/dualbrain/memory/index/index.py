"""Search index: the vectors of all memories and the columns of the filters, rebuilt from the ledger at any time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.encoder import Float32Array
from dualbrain.errors import ConfigurationError
from dualbrain.memory.embedding.image_encoder import IMAGE_ENCODER_ID
from dualbrain.memory.embedding.joint_embedding import Alpha, EpisodeEmbedding, JointEmbedding
from dualbrain.memory.index.filters import Columns, Filter
from dualbrain.memory.ledger.events import EPISODE
from dualbrain.memory.ledger.hash_chain import verified_events
from dualbrain.memory.ledger.ledger import Ledger, LedgerReader, StoredVector
from dualbrain.memory.retrieval.mmr import check_diversity, select_diverse
from dualbrain.memory.retrieval.search import (
    FlatIndex,
    Mask,
    MemoryHit,
    Query,
    QueryComparison,
    RowNumbers,
    Weights,
    check_lambda,
    contract_weights,
)
from dualbrain.memory.state.episode_record import decode_stored_episode
from dualbrain.memory.state.snapshot import MemorySnapshot
from dualbrain.memory.state.state import LedgerState, MemoryState

COSINE_ERROR_BOUND = 1e-5
"""Bound on the rounding error of a float32 cosine."""


@dataclass(frozen=True, slots=True)
class RankingOptions:
    """Ranking of hits: their number `k`, λ_s, and the penalty `diversity` on similarity among hits."""

    k: int
    lambda_s: float
    diversity: float = 0.0

    def __post_init__(self) -> None:
        """Raise `ConfigurationError` for λ_s or a diversity outside [0, 1]."""
        check_lambda(self.lambda_s)
        check_diversity(self.diversity)


@dataclass(frozen=True, slots=True, kw_only=True)
class RetrievalScope:
    """The memories whose weights count for a contract: of a robot, a registry and, if any are named, of `writers`.

    Memories of one contract are combined with a kernel of bandwidth ℓ (see `retrieval.search.contract_weights`).
    """

    robot: str
    registry: str
    bandwidth: float
    writers: tuple[str, ...] = ()

    @property
    def counted(self) -> Filter:
        """The filter of these memories."""
        return Filter(robot=self.robot, registry=self.registry, writers=self.writers)


class Index:
    """Search index with one row per memory, in the order of the state. All vectors are in RAM, and a scan is exact."""

    def __init__(self, embedding: JointEmbedding) -> None:
        """Create an index without rows."""
        self.embedding = embedding
        self.flat_index = FlatIndex(embedding.dim)
        self.columns = Columns()

    @property
    def rows(self) -> Float32Array:
        """All vectors, shape (n, dim); read-only."""
        return self.flat_index.rows

    @property
    def masks(self) -> NDArray[np.uint8]:
        """Mask of the blocks of each row, shape (n,)."""
        return self.flat_index.masks

    def add(self, memo: MemoryState, vector: StoredVector | None) -> None:
        """Append `memo` with its vector; for robots without limits in this memory the row is zero.

        Raises `ConfigurationError` if the vector is missing or was computed by another embedding.
        """
        row, mask = np.zeros(self.embedding.dim, np.float32), 0
        if self.embedding.supports(memo.robot):
            version, name = self.embedding.version(memo.robot), f"memory {memo.id}"
            row, mask = decode_vector(vector, version, self.embedding.dim, name), vector.mask if vector else 0
        self._add_row(memo, row, mask)

    def _add_row(self, memo: MemoryState, row: Float32Array, mask: int) -> None:
        self.flat_index.add(row, memo.weight, mask)
        self.columns.add(memo)

    def load(self, snapshot: MemorySnapshot) -> None:
        """Append the rows of a snapshot to an index without rows."""
        weights = np.array([memo.weight for memo in snapshot.state.memories])
        self.flat_index.load(snapshot.rows, weights, snapshot.masks)
        for memo in snapshot.state.memories:
            self.columns.add(memo)

    def is_compatible(self, snapshot: MemorySnapshot) -> bool:
        """Whether the rows of `snapshot` were computed by this embedding."""
        return snapshot.rows.shape[1] == self.embedding.dim and snapshot.versions == self.versions(snapshot.state)

    def versions(self, state: LedgerState) -> dict[str, str]:
        """Embedding version of each robot in `state`, "" for robots without limits in this memory."""
        robots = {memo.robot for memo in state.memories}
        supports = self.embedding.supports
        return {robot: self.embedding.version(robot) if supports(robot) else "" for robot in robots}

    def sync(self, state: LedgerState, rows: Sequence[int]) -> None:
        """Copy weight and status of some `rows` from `state`."""
        for row in rows:
            self.flat_index.set_weight(row, state.memories[row].weight)
            self.columns.set_status(row, state.memories[row].status)

    def query(self, embedded: EpisodeEmbedding, alpha: Alpha) -> Query:
        """The query with its blocks weighted by `alpha`."""
        scale = self.embedding.expand_alpha(alpha)
        return Query(embedded.vector * scale, embedded.mask, alpha.weight_by_mask(), scale)

    def retrieve(
        self, query: Query, scope: RetrievalScope, searches: Sequence[tuple[Filter, RankingOptions]]
    ) -> list[tuple[MemoryHit, ...]]:
        """For each search the best memories that pass its filter, ranked by similarity and the weight w̄."""
        compared, counted = self.flat_index.compare(query), self.columns.mask(scope.counted)
        codes = self.columns.contract_codes
        weights = contract_weights(compared, self.flat_index.weights, codes, counted, scope.bandwidth)
        return [
            rank_rows(self.flat_index, compared, self.columns.mask(where), ranking, weights)
            for where, ranking in searches
        ]

    def find_similar(self, query: Query, where: Filter, min_cosine: float, max_count: int) -> list[tuple[int, float]]:
        """At most `max_count` rows that pass `where` with a cosine of at least `min_cosine`, and their cosines.

        The nearest row is first; among equals the newest.
        """
        compared = self.flat_index.compare(query)
        rows = np.flatnonzero(self.columns.mask(where) & (compared.cosine >= min_cosine))
        if rows.size > max_count > 0:
            rough = compared.cosine[rows]
            rows = rows[rough >= np.partition(rough, -max_count)[-max_count] - COSINE_ERROR_BOUND]
        cosines = self.flat_index.cosines(rows, compared.query)
        order = np.lexsort((-rows, -cosines))[:max_count]
        return [(int(rows[i]), float(cosines[i])) for i in order]

    def block_cosines(self, row: int, embedded: EpisodeEmbedding) -> dict[str, float]:
        """The cosine of each block that both the row and the query have."""
        stored = self.embedding_of(row)
        return self.embedding.block_cosines(stored.vector, embedded.vector, stored.mask & embedded.mask)

    def vectors(self, rows: RowNumbers) -> Float32Array:
        """The vectors of some rows, shape (n_rows, dim)."""
        return self.rows[rows]

    def embedding_of(self, row: int) -> EpisodeEmbedding:
        """The vector and the mask of one row."""
        return EpisodeEmbedding(self.rows[row], int(self.masks[row]))


def decode_vector(vector: StoredVector | None, version: str, dim: int, name: str) -> Float32Array:
    """The numbers of a stored vector, shape (dim,).

    Raises `ConfigurationError`, with the `name` of its memory, if it is missing or was computed by another embedding.
    """
    if vector is None or vector.version != version or len(vector.data) != 4 * dim:
        raise ConfigurationError(
            f"embedding of {name}",
            got=vector and vector.version,
            allowed=version,
            fix="Use the previous encoder and settings, or recompute all vectors: `dualbrain memory rebuild`.",
        )
    return np.frombuffer(vector.data, "<f4")


def rank_rows(
    flat_index: FlatIndex, compared: QueryComparison, eligible: Mask, ranking: RankingOptions, weights: Weights
) -> tuple[MemoryHit, ...]:
    """The best of the `eligible` rows, shape (n,), with these `weights`, shape (n,), and the diversity of `ranking`."""
    if ranking.diversity == 0.0:
        return flat_index.top_k(compared, eligible, ranking.k, ranking.lambda_s, weights)
    return select_diverse(flat_index, compared, eligible, ranking.k, ranking.lambda_s, ranking.diversity, weights)


def to_stored_vector(embedded: EpisodeEmbedding, version: str) -> StoredVector:
    """The vector in the form in which the ledger stores it."""
    return StoredVector(version, embedded.vector.astype("<f4").tobytes(), embedded.mask)


def rebuild_vectors(ledger: Ledger, embedding: JointEmbedding) -> int:
    """Recompute all vectors from the episodes, for a new encoder or other features; the events stay unchanged.

    Returns the number of vectors. Episodes of robots without limits in `embedding` lose their vectors until a later
    rebuild; image features of another encoder become missing blocks.
    """
    vectors = dict(compute_vectors(ledger, embedding))
    ledger.replace_vectors(vectors)
    return len(vectors)


def compute_vectors(ledger: LedgerReader, embedding: JointEmbedding) -> Iterator[tuple[int, StoredVector]]:
    """Event number and recomputed vector of every episode; raises `CorruptLedgerError` at a broken link."""
    for event in verified_events(ledger.events(), str(ledger.path)):
        if event.kind != EPISODE:
            continue
        stored = decode_stored_episode(event.payload)
        episode = stored.episode
        if embedding.supports(episode.robot):
            image = stored.image if stored.image and stored.image.encoder == IMAGE_ENCODER_ID else None
            embedded = embedding.embed(episode.instruction, episode.summary, stored.state, episode.robot, image)
            yield event.seq, to_stored_vector(embedded, embedding.version(episode.robot))
