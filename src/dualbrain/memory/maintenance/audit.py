"""The audit (paper section 8): contradictions, repetitions and sources of memories.

An audit changes nothing. A person or a replay decides on the consequences, and every decision can be reversed.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator

import msgspec
import numpy as np

from dualbrain.memory.ledger.events import (
    ADAPTER,
    NEIGHBOURS,
    USED,
    WEIGHT,
    AdapterUse,
    MemoryUses,
    NeighbourUpdates,
    WeightUpdate,
)
from dualbrain.memory.maintenance.contradiction import is_contradicted
from dualbrain.memory.memory import Memory
from dualbrain.memory.plasticity.plan_similarity import same_plan
from dualbrain.memory.plasticity.retrieval_utility import RetrievalUtility, summarize_uses
from dualbrain.memory.state.derivation import effective_events
from dualbrain.memory.state.state import MemoryState

ROWS_PER_BLOCK = 256
"""Number of rows that are compared at a time."""
SIMILAR_COSINE, DUPLICATE_COSINE = 0.9, 0.999
"""Least cosine of two similar situations, and of two identical ones."""
STRUGGLE_FACTOR = 10.0
"""A success with Δ above this many ε is reported as a struggle."""


class AuditFinding(msgspec.Struct, frozen=True):
    """One suspicion: its kind, the memory, the memories that contradict or repeat it, and an explanation."""

    kind: str
    memory: str
    others: tuple[str, ...]
    text: str


class SourceReport(msgspec.Struct, frozen=True, kw_only=True):
    """The influence of one source: its memories by status, the weights it changed, and the adapters trained on it.

    `touched` is the number of changed weights, `moved` is Σ|Δw|.
    """

    source: str
    memories: tuple[str, ...]
    statuses: dict[str, int]
    touched: int
    moved: float
    adapters: tuple[str, ...]


class AuditReport(msgspec.Struct, frozen=True):
    """The findings by kind, the sources by influence, and the utility of retrieved memories."""

    memories: int
    findings: tuple[AuditFinding, ...]
    sources: tuple[SourceReport, ...]
    utility: RetrievalUtility


def audit(memory: Memory) -> AuditReport:
    """Find label conflicts, near-duplicates and implausible outcomes among all active memories and candidates."""
    pairs = list(_similar_pairs(memory, SIMILAR_COSINE))
    findings = [*_conflicts(memory, pairs), *_duplicates(memory, pairs), *_implausible_outcomes(memory)]
    return AuditReport(len(memory), tuple(findings), source_reports(memory), compute_utility(memory))


def compute_utility(memory: Memory) -> RetrievalUtility:
    """Memory Retrieval Utility over all runs that recorded the use of memories."""
    recorded = [
        msgspec.json.decode(event.payload, type=MemoryUses).uses for event in effective_events(memory.ledger, (USED,))
    ]
    return summarize_uses([use for uses in recorded for use in uses])


def source_reports(memory: Memory) -> tuple[SourceReport, ...]:
    """The blast radius of each source, largest influence first."""
    touched, moved = defaultdict[str, set[str]](set), defaultdict[str, float](float)
    for source, name, change in _weight_changes(memory):
        touched[source].add(name)
        moved[source] += change
    uses = [
        msgspec.json.decode(event.payload, type=AdapterUse) for event in effective_events(memory.ledger, (ADAPTER,))
    ]
    reports = list[SourceReport]()
    for source in {memo.provenance.source for memo in memory.state.memories}:
        memos = [memo for memo in memory.state.memories if memo.provenance.source == source]
        names = frozenset(memo.id for memo in memos)
        adapters = tuple(sorted({use.adapter for use in uses if names & set(use.memories)}))
        statuses = dict(Counter(memo.status for memo in memos))
        ids = tuple(memo.id for memo in memos)
        reports.append(
            SourceReport(
                source=source,
                memories=ids,
                statuses=statuses,
                touched=len(touched[source]),
                moved=moved[source],
                adapters=adapters,
            )
        )
    return tuple(sorted(reports, key=lambda report: (-report.moved, report.source)))


def _weight_changes(memory: Memory) -> Iterator[tuple[str, str, float]]:
    """Source, memory and |Δw| of every change of another memory's weight, as it was first applied."""
    state = memory.state
    for event in effective_events(memory.ledger, (WEIGHT, NEIGHBOURS)):
        if event.kind == WEIGHT:
            update = msgspec.json.decode(event.payload, type=WeightUpdate)
            if update.cause != update.memory:
                yield state[update.cause].provenance.source, update.memory, abs(update.after - update.before)
        else:
            neighbours = msgspec.json.decode(event.payload, type=NeighbourUpdates)
            for name, offset in zip(neighbours.memories, neighbours.offsets, strict=True):
                yield state[neighbours.cause].provenance.source, name, abs(offset)


def _similar_pairs(memory: Memory, min_cosine: float) -> Iterator[tuple[MemoryState, MemoryState, float]]:
    """Pairs (later, earlier, cosine) of the same robot and registry with a cosine of at least `min_cosine`."""
    memos, index = memory.state.memories, memory.index
    alpha = memory.config.embedding.alpha
    scale, shares = memory.embedding.expand_alpha(alpha), alpha.weight_by_mask()
    rows, masks = index.rows, index.masks
    active = np.array([memo.status not in ("quarantined", "forgotten") for memo in memos], bool)
    for start in range(0, len(memos), ROWS_PER_BLOCK):
        block = slice(start, min(start + ROWS_PER_BLOCK, len(memos)))
        both = shares[masks[block, None] & masks[None, : block.stop]]
        product = (rows[block] * scale) @ rows[: block.stop].T
        cosine = np.divide(product, both, out=np.zeros_like(product), where=both > 0.0)
        for i, j in zip(*np.nonzero(cosine >= min_cosine), strict=True):
            row = start + int(i)
            one, other = memos[row], memos[int(j)]
            if j < row and active[row] and active[j] and (one.robot, one.registry) == (other.robot, other.registry):
                yield one, other, float(cosine[i, j])


def _conflicts(memory: Memory, pairs: list[tuple[MemoryState, MemoryState, float]]) -> Iterator[AuditFinding]:
    """Memories with which too few comparable memories agree: same plan, similar situation, opposite r.

    The test is that of `contradiction`. If outcomes are partly random, a correct memory may be reported, too; such a
    memory is misleading all the same.
    """
    against, agreeing = defaultdict[str, list[str]](list), Counter[str]()
    for one, other, _ in pairs:
        both_guide = one.guidance != "none" != other.guidance
        if both_guide and one.provenance.skills == other.provenance.skills and _is_same_contract(memory, one, other):
            if one.r != other.r:
                against[one.id].append(other.id)
                against[other.id].append(one.id)
            else:
                agreeing.update((one.id, other.id))
    for name, others in sorted(against.items(), key=lambda item: (-len(item[1]), item[0])):
        if is_contradicted(agreeing[name], agreeing[name] + len(others)):
            memo = memory.state[name]
            text = f"{memo.kind}, but {len(others)} similar ones had the opposite outcome and {agreeing[name]} the same"
            yield AuditFinding("label conflict", name, tuple(others), text)


def _is_same_contract(memory: Memory, one: MemoryState, other: MemoryState) -> bool:
    if one.provenance.contract == other.provenance.contract:
        return True
    return same_plan(memory.read_episode(one.id).contract, memory.read_episode(other.id).contract)


def _duplicates(memory: Memory, pairs: list[tuple[MemoryState, MemoryState, float]]) -> Iterator[AuditFinding]:
    """Memories that repeat an earlier one: the same situation, contract and source."""
    repeats = defaultdict[str, list[str]](list)
    for one, other, cosine in pairs:
        if cosine >= DUPLICATE_COSINE and _duplicate_key(one) == _duplicate_key(other):
            repeats[other.id].append(one.id)
    firsts = {name: others for name, others in repeats.items() if not any(name in rest for rest in repeats.values())}
    for name, others in sorted(firsts.items(), key=lambda item: (-len(item[1]), item[0])):
        yield AuditFinding(
            "near duplicates", name, tuple(others), f"{len(others)} more with the same situation, contract and source"
        )


def _duplicate_key(memo: MemoryState) -> tuple[str, str, str]:
    """Properties in which near-duplicates agree: contract, source and outcome."""
    return memo.provenance.contract, memo.provenance.source, memo.kind


def _implausible_outcomes(memory: Memory) -> Iterator[AuditFinding]:
    """Outcomes that do not fit their Δ: a success with a large Δ, or a failure without any intervention."""
    rule = memory.config.plasticity
    for memo in memory.state.memories:
        if memo.status in ("quarantined", "forgotten") or memo.Delta is None or rule is None:
            continue
        if memo.r and memo.Delta > STRUGGLE_FACTOR * rule.epsilon:
            yield AuditFinding("struggle", memo.id, (), f"recorded as a success with Δ = {memo.Delta:.4f}")
        elif memo.kind == "failed" and memo.Delta == 0.0:
            yield AuditFinding(
                "untouched failure",
                memo.id,
                (),
                "failed without any intervention: was the outcome perceived correctly?",
            )
