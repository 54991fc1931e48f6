"""One of many: episodes that answer the same question with the same plan are one sample."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import msgspec

from dualbrain.adaptation.curation.candidate import Candidate
from dualbrain.memory.plasticity.plan_similarity import same_plan


class Kept(msgspec.Struct, frozen=True):
    """The episode that is kept, the one of least Δ, and those that it stands for, oldest first."""

    one: Candidate
    repeats: tuple[Candidate, ...]


def merge(found: Sequence[Candidate]) -> list[Kept]:
    """`found` without near-duplicates, in its order.

    Near-duplicates have the same question (scene in symbols, words but for case and space) and the same plan (skills,
    names, choices, numbers within 5 %). Law: no two that are kept are near-duplicates, each that is not is one of a
    kept one, and what is kept has the least Δ of those it stands for. Different plans for one question all stay: each
    was found good.
    """
    groups = defaultdict[tuple[str, ...], list[list[Candidate]]](list)
    for one in sorted(found, key=_best):
        alike = groups[_question(one)]
        plan = next((group for group in alike if same_plan(_plain(group[0]), _plain(one))), None)
        if plan is None:
            alike.append([one])
        else:
            plan.append(one)
    kept = [
        Kept(group[0], tuple(sorted(group[1:], key=lambda c: c.memo.seq)))
        for alike in groups.values()
        for group in alike
    ]
    return sorted(kept, key=lambda pair: pair.one.memo.seq)


def _best(one: Candidate) -> tuple[float, int]:
    return (one.memo.Delta or 0.0, one.memo.seq)


def _question(one: Candidate) -> tuple[str, str]:
    return one.summary, " ".join(one.instruction.casefold().split())


def _plain(one: Candidate) -> dict[str, object]:
    return msgspec.to_builtins(one.contract)
