"""Verification of a memory: chain, weights, snapshot and vectors, each against the events of the ledger."""

from __future__ import annotations

import msgspec

from dualbrain.memory.embedding.joint_embedding import JointEmbedding
from dualbrain.memory.index.index import compute_vectors
from dualbrain.memory.ledger.hash_chain import ChainReport, Head
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.state.derivation import derive_state
from dualbrain.memory.state.snapshot import read_snapshot


class Verification(msgspec.Struct, frozen=True):
    """Result of a verification: the chain, the snapshot, and the number of invalid vectors.

    `vectors_wrong` counts vectors that are wrong, missing or surplus; None if the vectors were not checked.
    """

    chain: ChainReport
    memories: int = 0
    snapshot: str = "none"
    vectors_wrong: int | None = None

    @property
    def is_intact(self) -> bool:
        """Whether everything that was checked is valid."""
        return self.chain.is_intact and self.snapshot != "differs" and not self.vectors_wrong


def verify(
    ledger: LedgerReader, *, anchor: Head | None = None, embedding: JointEmbedding | None = None
) -> Verification:
    """Check the chain; if it is valid, derive all weights and compare the snapshot.

    With an `embedding`, every vector is recomputed and compared bit for bit.
    """
    chain = ledger.verify(anchor)
    if not chain.is_intact:
        return Verification(chain)
    state = derive_state(ledger)
    stored_snapshot = read_snapshot(ledger)
    snapshot = "none"
    if stored_snapshot is not None:
        derived = derive_state(ledger, head=stored_snapshot.head.seq)
        snapshot = "agrees" if derived.memories == stored_snapshot.state.memories else "differs"
    wrong = None
    if embedding is not None:
        stored, computed = dict(ledger.vectors()), dict(compute_vectors(ledger, embedding))
        surplus = stored.keys() - computed.keys()
        wrong = sum(stored.get(seq) != vector for seq, vector in computed.items()) + len(surplus)
    return Verification(chain, len(state), snapshot, wrong)
