"""One of many: episodes that answer the same question with the same plan are one sample."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import msgspec

from dualbrain.adaptation.curation.candidate import Candidate
from dualbrain.memory.plasticity.plan_similarity import same_plan


class DuplicateGroup(msgspec.Struct, frozen=True):
    """The episode that is kept, the one of least Δ, and those that it stands for, oldest first."""

    representative: Candidate
    duplicates: tuple[Candidate, ...]


def merge_duplicates(found: Sequence[Candidate]) -> list[DuplicateGroup]:
    """`found` without near-duplicates, in its order.

    Near-duplicates have the same question (scene in symbols, words but for case and space) and the same plan (skills,
    names, choices, numbers within 5 %). Law: no two that are kept are near-duplicates, each that is not is one of a
    kept one, and what is kept has the least Δ of those it stands for. Different plans for one question all stay: each
    was found good.
    """
    groups = defaultdict[tuple[str, ...], list[list[Candidate]]](list)
    for one in sorted(found, key=_sort_key):
        alike = groups[_question_key(one)]
        plan = next((group for group in alike if same_plan(_contract_data(group[0]), _contract_data(one))), None)
        if plan is None:
            alike.append([one])
        else:
            plan.append(one)
    kept = [
        DuplicateGroup(group[0], tuple(sorted(group[1:], key=lambda c: c.memory.seq)))
        for alike in groups.values()
        for group in alike
    ]
    return sorted(kept, key=lambda pair: pair.representative.memory.seq)


def _sort_key(one: Candidate) -> tuple[float, int]:
    return (one.memory.Delta or 0.0, one.memory.seq)


def _question_key(one: Candidate) -> tuple[str, str]:
    return one.summary, " ".join(one.instruction.casefold().split())


def _contract_data(one: Candidate) -> dict[str, object]:
    return msgspec.to_builtins(one.contract)
