"""Deduplication: episodes that answer the same question with the same plan become one sample."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import msgspec

from dualbrain.adaptation.curation.candidate import Candidate
from dualbrain.memory.plasticity.plan_similarity import same_plan


class DuplicateGroup(msgspec.Struct, frozen=True):
    """The episode that is kept, the one of least Δ, and its near-duplicates, oldest first."""

    representative: Candidate
    duplicates: tuple[Candidate, ...]


def merge_duplicates(candidates: Sequence[Candidate]) -> list[DuplicateGroup]:
    """`candidates` without near-duplicates, in the same order.

    Near-duplicates have the same question (scene summary; instruction up to case and white space) and the same plan
    (skills, names, choices, numbers within 5 %). Law: no two kept episodes are near-duplicates, each removed one is a
    near-duplicate of a kept one, and the kept one has the least Δ of its group. Different plans for one question are
    all kept: each of them succeeded.
    """
    groups = defaultdict[tuple[str, ...], list[list[Candidate]]](list)
    for one in sorted(candidates, key=_sort_key):
        plan_groups = groups[_question_key(one)]
        plan = next((group for group in plan_groups if same_plan(_contract_data(group[0]), _contract_data(one))), None)
        if plan is None:
            plan_groups.append([one])
        else:
            plan.append(one)
    kept = [
        DuplicateGroup(group[0], tuple(sorted(group[1:], key=lambda c: c.memory.seq)))
        for plan_groups in groups.values()
        for group in plan_groups
    ]
    return sorted(kept, key=lambda pair: pair.representative.memory.seq)


def _sort_key(one: Candidate) -> tuple[float, int]:
    return (one.memory.Delta or 0.0, one.memory.seq)


def _question_key(one: Candidate) -> tuple[str, str]:
    return one.summary, " ".join(one.instruction.casefold().split())


def _contract_data(one: Candidate) -> dict[str, object]:
    return msgspec.to_builtins(one.contract)
