"""Is memory what was written: the chain, the weights, the snapshot and the vectors, each against the events."""

from __future__ import annotations

import msgspec

from dualbrain.memory.embedding.joint_embedding import JointEmbedding
from dualbrain.memory.index.index import compute_vectors
from dualbrain.memory.ledger.hash_chain import ChainReport, Head
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.state.derivation import derive_state
from dualbrain.memory.state.snapshot import read_snapshot


class Verification(msgspec.Struct, frozen=True):
    """What was found: the chain, and how many vectors are wrong, missing or left over (None: not looked at)."""

    chain: ChainReport
    memories: int = 0
    snapshot: str = "none"
    vectors_wrong: int | None = None

    @property
    def is_intact(self) -> bool:
        """True if everything that was looked at holds."""
        return self.chain.is_intact and self.snapshot != "differs" and not self.vectors_wrong


def verify(
    ledger: LedgerReader, *, anchor: Head | None = None, embedding: JointEmbedding | None = None
) -> Verification:
    """Walk the chain; if it holds, derive all weights and compare the snapshot.

    With an `embedding`, every vector is made again and compared to the bit.
    """
    chain = ledger.verify(anchor)
    if not chain.is_intact:
        return Verification(chain)
    state = derive_state(ledger)
    found = read_snapshot(ledger)
    snapshot = "none"
    if found is not None:
        then = derive_state(ledger, head=found.head.seq)
        snapshot = "agrees" if then.memories == found.state.memories else "differs"
    wrong = None
    if embedding is not None:
        stored, anew = dict(ledger.vectors()), dict(compute_vectors(ledger, embedding))
        wrong = sum(stored.get(seq) != vector for seq, vector in anew.items()) + len(stored.keys() - anew.keys())
    return Verification(chain, len(state), snapshot, wrong)
