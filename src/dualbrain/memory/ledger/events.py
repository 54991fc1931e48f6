"""Kinds of ledger events, and the payloads of all kinds besides episodes."""

from __future__ import annotations

from typing import Literal

import msgspec

from dualbrain.memory.plasticity.affine_map import AffineMap
from dualbrain.records import MemoryUse

EPISODE, WEIGHT, NEIGHBOURS = "episode", "weight", "neighbours"
CONFIRM, QUARANTINE, RELEASE, TOMBSTONE = "confirm", "quarantine", "release", "tombstone"
ROLLBACK, FOLDED, COMPACTED, SNAPSHOT = "rollback", "folded", "compacted", "snapshot"
AUDIT, REPLAYED, ADAPTER, USED = "audit", "replayed", "adapter", "used"
VECTORS, ACCEPTED = "vectors", "accepted"
WEIGHT_EVENT_KINDS = (EPISODE, WEIGHT, NEIGHBOURS, FOLDED)
"""Kinds of events that create memories and change weights."""
Status = Literal["active", "candidate", "quarantined", "forgotten"]
"""active: retrieved for the planner. candidate: a success that is not confirmed yet. quarantined: not retrieved, and
its influence on weights is undone while the status lasts. forgotten: the same, permanently."""
STATUS_BY_EVENT_KIND: dict[str, Status] = {
    CONFIRM: "active",
    QUARANTINE: "quarantined",
    RELEASE: "active",
    TOMBSTONE: "forgotten",
}
"""The status that each kind of status event sets."""
COMPACTION_ACTOR = "compaction"
"""The actor of the status events that a compaction writes."""
VOID_STATUSES: tuple[Status, ...] = ("quarantined", "forgotten")
"""Weight updates that memories with these statuses caused do not count."""


class WeightUpdate(msgspec.Struct, frozen=True, kw_only=True):
    """Payload of a weight event: the outcome of episode `cause` changed the weight of `memory`.

    The weight changed from `before` to `after`. `rank` is the rank of the memory in the prompt, 0 for the new memory
    itself. `gain` and `offset` are those of the clipped affine map that was applied, so that a replay needs neither the
    rule nor the index. `share` is below 1 if the influence of the source was bounded (see `TrustConfig`).
    """

    cause: str
    memory: str
    rule: Literal["reinforce", "suppress"]
    rank: int
    gain: float
    offset: float
    before: float
    after: float
    share: float = 1.0

    @property
    def affine_map(self) -> AffineMap:
        """The update as a map of the weight."""
        return AffineMap(self.gain, self.offset)


class NeighbourUpdates(msgspec.Struct, frozen=True):
    """Payload of a neighbours event: w_j ← clip(w_j + offset_j) for each of `memories`, in this order (paper 5.3).

    offset_j = κ ξ exp(−‖e_j − e_i‖²/2ℓ²), where i is the episode `cause`. Ids and offsets are stored, so that a replay
    needs neither the index nor the encoder.
    """

    cause: str
    rule: Literal["reinforce", "suppress"]
    memories: tuple[str, ...]
    offsets: tuple[float, ...]


class StatusChange(msgspec.Struct, frozen=True):
    """Payload of confirm, quarantine, release and tombstone events: the `memories`, the reason and the actor."""

    memories: tuple[str, ...]
    reason: str
    actor: str


class Rollback(msgspec.Struct, frozen=True):
    """Payload of a rollback: from this event on, memory has the state of event `target` (see `state.history`)."""

    target: int
    reason: str
    actor: str


class FoldedUpdates(msgspec.Struct, frozen=True, kw_only=True):
    """Payload of a folded event: all weight events of `memory` before a compaction as one map, and the exact weight.

    The map gives the result for any initial weight; `weight` is the result of the sequential updates, bit for bit.
    `has_own_outcome`: whether the updates contain those that the outcome of `memory` caused; None in events of earlier
    versions.
    """

    memory: str
    gain: float
    offset: float
    lower: float
    upper: float
    weight: float
    reinforced: int
    suppressed: int
    has_own_outcome: bool | None = None

    @property
    def affine_map(self) -> AffineMap:
        """All updates as one map of the initial weight."""
        return AffineMap(self.gain, self.offset, self.lower, self.upper)


class CompactionRecord(msgspec.Struct, frozen=True):
    """Payload of the first event of a compacted ledger: head and file name of the full ledger that was compacted."""

    seq: int
    hash: str
    archive: str


class SnapshotRecord(msgspec.Struct, frozen=True):
    """Payload of a snapshot event: SHA-256 of the file beside the ledger that contains the state at event `as_of`."""

    as_of: int
    sha256: str


class VectorDigests(msgspec.Struct, frozen=True):
    """Payload of a vectors event: new digest of the vector of each episode, by event number; "" if it was removed."""

    digests: dict[int, str]


class AcceptedLoss(msgspec.Struct, frozen=True, kw_only=True):
    """Payload of an accepted event: the anchors (number and hash of an event) that the ledger no longer contains.

    A person accepted their loss, so that the ledger may be written again.
    """

    anchors: tuple[tuple[int, str], ...]
    reason: str
    actor: str


class MemoryUses(msgspec.Struct, frozen=True):
    """Payload of a used event: the use of each memory that was in the prompt of `episode`."""

    episode: str
    uses: tuple[MemoryUse, ...]


class AdapterUse(msgspec.Struct, frozen=True):
    """Payload of an adapter event: `adapter` was trained on `memories` (ids) from the data set with hash `dataset`."""

    adapter: str
    dataset: str
    memories: tuple[str, ...]


class ReplayFinding(msgspec.Struct, frozen=True, kw_only=True):
    """Payload of a replayed event: the outcomes of running the contract of `memory` again in simulation.

    `agrees` is False if too many trials had another outcome than the memory (see `runtime.memory_replay`).
    """

    memory: str
    agrees: bool
    remembered: str
    outcomes: tuple[str, ...]
    Deltas: tuple[float | None, ...]
    reason: str
    actor: str
