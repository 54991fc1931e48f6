"""Search index whose vectors are in a vector engine, with the results of the scan in RAM.

An engine finds the rows nearest to the query. The rank of a row also depends on the weight w̄ of its contract, which the
engine does not know, so the search stops when no other row can have a higher score: with the k-th best score θ of the
rows seen so far and the cosine c of the last row of a group, every other row of the group has

    R ≤ λ_s (1 + c)/2 + (1 − λ_s) u,    u = min{1, max{0, w₀ + Σ_j max(w_j − w₀, 0)}} ≥ w̄

over the memories j of its contract. Otherwise the number of requested rows is increased. All scores are computed from
the vectors of the ledger, which are compared with their digests. Memories whose scores are equal up to rounding may
have another order than in the scan.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.encoder import Float32Array
from dualbrain.memory.embedding.joint_embedding import EpisodeEmbedding, JointEmbedding
from dualbrain.memory.index.engines.choice import open_engine
from dualbrain.memory.index.engines.engine import EngineRefusalError, EngineUnreachableError, Numbers, VectorEngine
from dualbrain.memory.index.filters import Filter
from dualbrain.memory.index.index import (
    COSINE_ERROR_BOUND,
    Index,
    RankingOptions,
    RetrievalScope,
    decode_vector,
    rank_rows,
)
from dualbrain.memory.ledger.events import VECTORS
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.ledger.shared.config import SCAN
from dualbrain.memory.plasticity.hebbian_update import W0
from dualbrain.memory.retrieval.mmr import CANDIDATE_FACTOR
from dualbrain.memory.retrieval.search import FlatIndex, Mask, MemoryHit, Query, RowNumbers, Weights, contract_weights
from dualbrain.memory.state.snapshot import MemorySnapshot
from dualbrain.memory.state.state import MemoryState

FIRST_COUNT, GROWTH = 256, 4
"""Number of rows of the first request for each group, and the factor of each further one."""
NEVER_STORED = -1
"""Flag of a row without a vector; 0: the engine lacks its vector, 1: the engine has it."""
BATCH = 2000
"""Vectors that are read from the ledger at once."""


class EngineIndex(Index):
    """See `Index`; weights, masks and columns are in RAM. While the engine does not answer, the ledger is read."""

    def __init__(self, embedding: JointEmbedding, engine: VectorEngine, ledger: LedgerReader) -> None:
        """Create an index without rows over the vectors of `ledger`; the engine may contain some of them already."""
        super().__init__(embedding)
        self.flat_index = FlatIndex(0)
        self._engine, self._ledger = engine, ledger
        self._revision = max((event.seq for event in ledger.events(VECTORS)), default=0)
        seqs, groups = engine.stored()
        order = np.argsort(seqs, kind="stable")
        self._stored = seqs[order], groups[order]
        self._seqs, self._codes, self._flags = _RowNumbers(), _RowNumbers(), _RowNumbers()
        self._code_of_group = dict[int, int]()
        self._versions = list[str]()
        self._may_add = True

    # --- rows -------------------------------------------------------------------------------------------------------

    def _add_row(self, memo: MemoryState, row: Float32Array, mask: int) -> None:
        super()._add_row(memo, np.empty(0, np.float32), mask)
        group = self._group_of(memo, mask)
        self._seqs.append(memo.seq)
        self._codes.append(self._code_of_group.setdefault(group, len(self._code_of_group)))
        version = self._version(memo.robot)
        self._versions.append(version)
        seqs, groups = self._stored
        found = slice(np.searchsorted(seqs, memo.seq), np.searchsorted(seqs, memo.seq, "right"))
        self._flags.append(int(group in groups[found]) if version else NEVER_STORED)

    def _group_of(self, memo: MemoryState, mask: int) -> int:
        """The group of a row: equal for equal robot, registry, guidance, mask, embedding and revision of vectors."""
        text = repr((memo.robot, memo.registry, memo.guidance, mask, self._version(memo.robot), self._revision))
        return int.from_bytes(hashlib.sha256(text.encode("utf-8", "surrogateescape")).digest()[:8], "big", signed=True)

    def _version(self, robot: str) -> str:
        """Version of the vectors of `robot`, "" for a robot without limits in this memory."""
        return self.embedding.version(robot) if self.embedding.supports(robot) else ""

    def load(self, snapshot: MemorySnapshot) -> None:
        """Append the rows of a snapshot to an index without rows; its vectors are not used."""
        for memo, mask in zip(snapshot.state.memories, snapshot.masks.tolist(), strict=True):
            self._add_row(memo, np.empty(0, np.float32), mask)

    def is_compatible(self, snapshot: MemorySnapshot) -> bool:
        """Whether the vectors of `snapshot` were computed by this embedding; it may contain none."""
        return snapshot.rows.shape[1] in (0, self.embedding.dim) and snapshot.versions == self.versions(snapshot.state)

    @property
    def rows(self) -> Float32Array:
        """All vectors, shape (n, dim), read from the ledger."""
        return self.vectors(np.arange(len(self.masks)))

    def embedding_of(self, row: int) -> EpisodeEmbedding:
        """The vector and the mask of one row."""
        return EpisodeEmbedding(self.vectors(np.array([row]))[0], int(self.masks[row]))

    def vectors(self, rows: RowNumbers) -> Float32Array:
        """Vectors of some rows from the ledger, shape (n_rows, dim); zero for robots without limits in this memory.

        Raises `ConfigurationError` if one is missing or was computed by another embedding.
        """
        found = np.zeros((len(rows), self.embedding.dim), np.float32)
        for first in range(0, len(rows), BATCH):
            part = rows[first : first + BATCH]
            seqs: list[int] = self._seqs.values[part].tolist()
            versions = [self._versions[int(row)] for row in part]
            wanted = [seq for seq, version in zip(seqs, versions, strict=True) if version]
            stored = self._ledger.selected_vectors(wanted)
            for place, (seq, version) in enumerate(zip(seqs, versions, strict=True), start=first):
                if version:
                    found[place] = decode_vector(stored.get(seq), version, self.embedding.dim, f"event {seq}")
        return found

    def update_engine(self) -> bool:
        """Add the rows that the engine lacks; False if it does not answer. Retrieval calls it, too."""
        if not self._may_add:
            return False
        missing = np.flatnonzero(self._flags.values == 0)
        groups = np.array(list(self._code_of_group), np.int64)
        try:
            for first in range(0, len(missing), BATCH):
                part = missing[first : first + BATCH]
                self._engine.add(self._seqs.values[part], groups[self._codes.values[part]], self.vectors(part))
                self._flags.values[part] = 1
        except EngineRefusalError as error:
            self._may_add = False
            self._ledger.notices += (f"New vectors are not added to the engine of the index. {error}",)
            return False
        except EngineUnreachableError:
            return False
        return True

    # --- search -----------------------------------------------------------------------------------------------------

    def retrieve(
        self, query: Query, scope: RetrievalScope, searches: Sequence[tuple[Filter, RankingOptions]]
    ) -> list[tuple[MemoryHit, ...]]:
        """For each search the best memories that pass its filter, ranked by similarity and the weight w̄."""
        self.update_engine()
        counted = self.columns.mask(scope.counted)
        bounds = _weight_bounds(self.flat_index.weights, self.columns.contract_codes, counted)
        vectors = _VectorCache(self.vectors, self.embedding.dim)
        return [self._search(query, scope.bandwidth, counted, bounds, vectors, *search) for search in searches]

    def _search(
        self,
        query: Query,
        bandwidth: float,
        counted: Mask,
        bounds: Weights,
        vectors: _VectorCache,
        where: Filter,
        ranking: RankingOptions,
    ) -> tuple[MemoryHit, ...]:
        eligible = self.columns.mask(where)
        depth = ranking.k if ranking.diversity == 0.0 else CANDIDATE_FACTOR * ranking.k
        if depth <= 0 or not eligible.any():
            return ()
        codes = self.columns.contract_codes
        for seen, last_cosine in self._rounds(query, eligible):
            known = self._with_contracts(seen & eligible, counted, codes)
            part = np.flatnonzero(known)
            flat = FlatIndex(self.embedding.dim)
            flat.load(vectors.read(part), self.flat_index.weights[part], self.masks[part])
            compared = flat.compare(query)
            weights = contract_weights(compared, flat.weights, codes[part], counted[part], bandwidth)
            best = flat.top_k(compared, eligible[part], depth, ranking.lambda_s, weights)
            unknown = eligible & ~known
            if self._is_complete(best, depth, unknown, last_cosine, bounds, ranking.lambda_s):
                hits = rank_rows(flat, compared, eligible[part], ranking, weights)
                return tuple(MemoryHit(int(part[hit.row]), hit.similarity, hit.weight, hit.score) for hit in hits)
        raise AssertionError("the last round contains every row")

    def _rounds(self, query: Query, eligible: Mask) -> Iterator[tuple[Mask, NDArray[np.float64]]]:
        """Rows seen so far, shape (n,), and the largest cosine of any other row of each group, shape (n_groups,).

        The last round contains all eligible rows.
        """
        codes, is_stored = self._codes.values, self._flags.values == 1
        groups = np.flatnonzero(np.bincount(codes[eligible & is_stored], minlength=len(self._code_of_group)))
        keys = list[int](self._code_of_group)
        seen, last = ~is_stored, np.full(len(keys), -np.inf)
        last[groups] = np.inf
        number = FIRST_COUNT
        try:
            while number <= min(self._engine.max_count, len(codes)):
                for code in map(int, groups[last[groups] > -np.inf]):
                    seqs, products = self._engine.nearest(keys[code], query.vector, number)
                    seen[self._rows_of(seqs)] = True
                    if len(seqs) < number:  # all rows of the group; one that the engine lacks is read from the ledger
                        seen |= codes == code
                        last[code] = -np.inf
                    else:
                        last[code] = self._cosine_bound(query, code, products)
                yield seen, last
                number *= GROWTH
        except EngineUnreachableError:
            pass
        yield seen | eligible, np.full(len(keys), -np.inf)

    def _rows_of(self, seqs: Numbers) -> RowNumbers:
        """The rows of those events that are in the state."""
        known = self._seqs.values
        places = np.minimum(np.searchsorted(known, seqs), len(known) - 1)
        return places[known[places] == seqs]

    def _cosine_bound(self, query: Query, code: int, products: Float32Array) -> float:
        """The largest cosine of a row of the group that is not among those with these `products`."""
        row = int(np.argmax(self._codes.values == code))
        share = float(query.weight_by_mask[int(self.masks[row]) & query.mask])
        return min(1.0, float(products[-1]) / share) if share > 0.0 else 0.0

    @staticmethod
    def _with_contracts(seen: Mask, counted: Mask, codes: NDArray[np.int32]) -> Mask:
        """The rows `seen` and every counted row of their contracts, so that w̄ of each of them is exact."""
        chosen = np.zeros(int(codes.max(initial=-1)) + 1, bool)
        chosen[codes[seen]] = True
        return seen | (counted & chosen[codes])

    def _is_complete(
        self,
        best: tuple[MemoryHit, ...],
        depth: int,
        unknown: Mask,
        last_cosine: NDArray[np.float64],
        bounds: Weights,
        lambda_s: float,
    ) -> bool:
        """Whether no `unknown` row can be among the best."""
        rows = np.flatnonzero(unknown)
        if rows.size == 0:
            return True
        if len(best) < depth:
            return False
        cosine = last_cosine[self._codes.values[rows]] + COSINE_ERROR_BOUND
        highest = lambda_s * (1.0 + cosine) / 2.0 + (1.0 - lambda_s) * bounds[rows]
        return best[-1].score > float(highest.max())

    def find_similar(self, query: Query, where: Filter, min_cosine: float, max_count: int) -> list[tuple[int, float]]:
        """See `Index.find_similar`."""
        self.update_engine()
        eligible = self.columns.mask(where)
        if max_count <= 0 or not eligible.any():
            return []
        vectors = _VectorCache(self.vectors, self.embedding.dim)
        for seen, last_cosine in self._rounds(query, eligible):
            rows = np.flatnonzero(seen & eligible)
            flat = FlatIndex(self.embedding.dim)
            flat.load(vectors.read(rows), self.flat_index.weights[rows], self.masks[rows])
            cosines = flat.cosines(np.arange(len(rows)), query)
            near = np.flatnonzero(flat.compare(query).cosine >= min_cosine)
            order = near[np.lexsort((-rows[near], -cosines[near]))][:max_count]
            threshold = min_cosine if len(order) < max_count else float(cosines[order[-1]])
            if not (eligible & ~seen).any() or threshold > last_cosine.max() + COSINE_ERROR_BOUND:
                return [(int(rows[i]), float(cosines[i])) for i in order]
        raise AssertionError("the last round contains every row")


class _VectorCache:
    """Vectors of the rows of one query, each read once."""

    def __init__(self, read: Callable[[RowNumbers], Float32Array], dim: int) -> None:
        self._read, self._known = read, np.empty(0, np.intp)
        self._vectors: Float32Array = np.empty((0, dim), np.float32)

    def read(self, rows: RowNumbers) -> Float32Array:
        """The vectors of `rows`, which are in ascending order, shape (n_rows, dim)."""
        missing = np.setdiff1d(rows, self._known, assume_unique=True)
        if missing.size:
            known = np.concatenate([self._known, missing])
            order = np.argsort(known)
            self._known, self._vectors = known[order], np.concatenate([self._vectors, self._read(missing)])[order]
        return self._vectors[np.searchsorted(self._known, rows)]


class _RowNumbers:
    """One number for each row, in an array that grows."""

    def __init__(self) -> None:
        self._array, self._count = np.empty(64, np.int64), 0

    def append(self, value: int) -> None:
        if self._count == len(self._array):
            self._array = np.concatenate([self._array, np.empty(self._count // 2, np.int64)])
        self._array[self._count] = value
        self._count += 1

    @property
    def values(self) -> Numbers:
        """All numbers, shape (n,); a view."""
        return self._array[: self._count]


def connect_engine(ledger: LedgerReader, dim: int) -> VectorEngine | None:
    """The engine that the file of a shared ledger names, until the ledger is closed.

    None for an index in RAM, also if the engine does not answer; then the ledger has a notice.
    """
    config = ledger.shared_config
    if config is None or config.index == SCAN:
        return None
    try:
        engine = open_engine(config.index, url=config.url, namespace=config.namespace, dim=dim)
    except EngineUnreachableError as error:
        _note_unreachable(ledger, error)
        return None
    ledger.resources.callback(engine.close)
    return engine


def create_index(embedding: JointEmbedding, ledger: LedgerReader, engine: VectorEngine | None) -> Index:
    """An index without rows, with `engine` if it answers."""
    if engine is not None:
        try:
            return EngineIndex(embedding, engine, ledger)
        except EngineUnreachableError as error:
            _note_unreachable(ledger, error)
    return Index(embedding)


def _note_unreachable(ledger: LedgerReader, error: EngineUnreachableError) -> None:
    ledger.notices += (f"The engine of the index cannot be used; all vectors are kept in memory. {error}",)


def _weight_bounds(weights: Weights, codes: NDArray[np.int32], counted: Mask) -> Weights:
    """Upper bound u of the weight w̄ of each row's contract for any query, shape (n,)."""
    n_contracts = int(codes.max(initial=-1)) + 1
    gain = np.bincount(codes, np.where(counted, np.maximum(weights - W0, 0.0), 0.0), n_contracts)
    known = np.bincount(codes, counted, n_contracts) > 0
    return np.where(known[codes], np.clip(W0 + gain[codes], 0.0, 1.0), weights)
