"""What memory writes into the ledger besides episodes: kinds of events and the form of their payloads."""

from __future__ import annotations

from typing import Literal

import msgspec

from dualbrain.memory.plasticity.affine_map import AffineMap
from dualbrain.records import MemoryUse

EPISODE, WEIGHT, NEIGHBOURS = "episode", "weight", "neighbours"
CONFIRM, QUARANTINE, RELEASE, TOMBSTONE = "confirm", "quarantine", "release", "tombstone"
ROLLBACK, FOLDED, COMPACTED, SNAPSHOT = "rollback", "folded", "compacted", "snapshot"
AUDIT, REPLAYED, ADAPTER, USED = "audit", "replayed", "adapter", "used"
WEIGHT_EVENT_KINDS = (EPISODE, WEIGHT, NEIGHBOURS, FOLDED)
"""Kinds that make memories and move weights."""
Status = Literal["active", "candidate", "quarantined", "forgotten"]
"""active: offered to the planner. candidate: a success that nothing has confirmed yet. quarantined: set aside, its
influence on weights undone as long as it is. forgotten: the same, for good."""
STATUS_BY_EVENT_KIND: dict[str, Status] = {
    CONFIRM: "active",
    QUARANTINE: "quarantined",
    RELEASE: "active",
    TOMBSTONE: "forgotten",
}
"""The status that each kind of status event gives."""
VOID_STATUSES: tuple[Status, ...] = ("quarantined", "forgotten")
"""What memories of these statuses did to weights does not count."""


class WeightUpdate(msgspec.Struct, frozen=True, kw_only=True):
    """Payload of a weight event: outcome of episode `cause` moved the weight of `memory` from `before` to `after`.

    `rank` is the place of the memory in the prompt, 0 for the new memory itself. `gain` and `offset` are the clipped
    affine map that was applied, so that a replay needs neither rule nor index. `share` < 1 if the influence of the
    source was bounded (see `trust.Trust`).
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
        """The map."""
        return AffineMap(self.gain, self.offset)


class NeighbourUpdates(msgspec.Struct, frozen=True):
    """Payload of a neighbours event: w_j ← clip(w_j + offset_j) for each of `memories`, in this order (paper 5.3).

    offset_j = κ ξ exp(−‖e_j − e_i‖²/2ℓ²), i being `cause`. Ids and offsets are stored, so that a replay depends neither
    on index nor embedder.
    """

    cause: str
    rule: Literal["reinforce", "suppress"]
    memories: tuple[str, ...]
    offsets: tuple[float, ...]


class StatusChange(msgspec.Struct, frozen=True):
    """Payload of confirm, quarantine, release and tombstone: which `memories`, why, and who says so."""

    memories: tuple[str, ...]
    reason: str
    actor: str


class Rollback(msgspec.Struct, frozen=True):
    """Payload of a rollback: from here on, memory is what it was at event `target` (see `lineage`)."""

    target: int
    reason: str
    actor: str


class FoldedUpdates(msgspec.Struct, frozen=True, kw_only=True):
    """Payload of a folded event: all weight events of `memory` up to a compaction as one map, and the exact weight.

    The map tells what any first weight would have become; `weight` is what the sequential updates made, to the bit.
    """

    memory: str
    gain: float
    offset: float
    lower: float
    upper: float
    weight: float
    reinforced: int
    suppressed: int

    @property
    def affine_map(self) -> AffineMap:
        """The map."""
        return AffineMap(self.gain, self.offset, self.lower, self.upper)


class CompactionRecord(msgspec.Struct, frozen=True):
    """Payload of the first event of a compacted ledger: the whole ledger it was made of, by head and file name."""

    seq: int
    hash: str
    archive: str


class SnapshotRecord(msgspec.Struct, frozen=True):
    """Payload of a snapshot event: the file beside the ledger that holds the state at event `as_of`, by SHA-256."""

    as_of: int
    sha256: str


class MemoryUses(msgspec.Struct, frozen=True):
    """Payload of a used event: what became of each memory that stood in the prompt of `episode`."""

    episode: str
    uses: tuple[MemoryUse, ...]


class AdapterUse(msgspec.Struct, frozen=True):
    """Payload of an adapter event: `adapter` was trained on `memories` (ids), from the data set `dataset` (hash)."""

    adapter: str
    dataset: str
    memories: tuple[str, ...]


class ReplayFinding(msgspec.Struct, frozen=True, kw_only=True):
    """Payload of a replayed event: what running the contract of `memory` again in simulation gave, try by try.

    `agrees` False: too many tries ended otherwise than the memory says (see `runtime.rerun`).
    """

    memory: str
    agrees: bool
    remembered: str
    outcomes: tuple[str, ...]
    Deltas: tuple[float | None, ...]
    reason: str
    actor: str
