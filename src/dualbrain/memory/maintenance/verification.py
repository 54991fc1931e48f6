"""Verification of a memory: chain, weights, snapshot and vectors, each against the events of the ledger."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec

from dualbrain.memory.embedding.joint_embedding import JointEmbedding
from dualbrain.memory.index.index import compute_vectors
from dualbrain.memory.ledger.anchors import check_anchors
from dualbrain.memory.ledger.hash_chain import ChainReport, Head
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.ledger.sqlite.tables import SCHEMA_VERSION
from dualbrain.memory.ledger.vectors import VectorReport
from dualbrain.memory.state.derivation import derive_state
from dualbrain.memory.state.snapshot import read_snapshot


class Verification(msgspec.Struct, frozen=True, kw_only=True):
    """Result of a verification: chain, snapshot, vectors, anchors, and structure of the file.

    `vectors` compares every vector with the digest in its event. `vectors_wrong` counts vectors that are wrong, missing
    or surplus after a recomputation; None if they were not recomputed. `anchor_faults` are sentences about anchors
    whose events are missing, `file_faults` are missing triggers and faults found by SQLite; `notices` are no faults.
    """

    chain: ChainReport
    memories: int = 0
    snapshot: str = "none"
    vectors: VectorReport = VectorReport()
    vectors_wrong: int | None = None
    anchors_compared: int = 0
    anchor_faults: tuple[str, ...] = ()
    file_faults: tuple[str, ...] = ()
    notices: tuple[str, ...] = ()

    @property
    def is_intact(self) -> bool:
        """Whether everything that was checked is valid."""
        faults = self.vectors.faults or self.vectors_wrong or self.anchor_faults or self.file_faults
        return self.chain.is_intact and self.snapshot != "differs" and not faults


def verify(
    ledger: LedgerReader,
    *,
    anchor: Head | None = None,
    embedding: JointEmbedding | None = None,
    run_folders: Sequence[Path] = (),
) -> Verification:
    """Check chain, anchors and vectors; if the chain is valid, derive all weights and compare the snapshot.

    `run_folders` are folders of runs with more anchors (see `anchors.check_anchors`). With an `embedding`, every vector
    is recomputed and compared bit for bit.
    """
    chain = ledger.verify(anchor)
    report = check_anchors(ledger, run_folders)
    missing = tuple(f"the {name} is missing" for name in ledger.missing_objects)
    found = Verification(
        chain=chain,
        anchors_compared=report.compared,
        anchor_faults=tuple(fault.sentence for fault in report.faults),
        file_faults=(*missing, *ledger.find_database_faults()),
        notices=report.notices,
    )
    if not chain.is_intact:
        return found
    state = derive_state(ledger)
    stored_snapshot = read_snapshot(ledger)
    snapshot = "none"
    if stored_snapshot is not None:
        derived = derive_state(ledger, head=stored_snapshot.head.seq)
        snapshot = "agrees" if derived.memories == stored_snapshot.state.memories else "differs"
    wrong = None
    if embedding is not None:
        stored, computed = dict(ledger.stored_vectors()), dict(compute_vectors(ledger, embedding))
        surplus = stored.keys() - computed.keys()
        wrong = sum(stored.get(seq) != vector for seq, vector in computed.items()) + len(surplus)
    vectors = ledger.verify_vectors() if ledger.schema == SCHEMA_VERSION else VectorReport()
    return msgspec.structs.replace(found, memories=len(state), snapshot=snapshot, vectors=vectors, vectors_wrong=wrong)
