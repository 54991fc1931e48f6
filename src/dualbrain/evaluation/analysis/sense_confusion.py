"""Confusion matrix of each sense of the robot against ground truth, from evaluation rows."""

from __future__ import annotations

from collections.abc import Iterable

import msgspec

from dualbrain.evaluation.analysis.violation_kinds import BROKEN, has_kind
from dualbrain.evaluation.results.episode_row import EpisodeRow

SENSE_COLUMNS = ("sense_placed", "sense_intact", "sense_held", "sense_undisturbed", "sense_fulfilled")
"""Columns of `EpisodeRow` with the verdicts of the senses."""


class SenseConfusion(msgspec.Struct, frozen=True, kw_only=True):
    """Number of rows by the verdict of one sense and by ground truth ("true": the sensed fact holds).

    `confirmed_false` are false confirmations, `contradicted_true` false alarms.
    """

    sense: str
    confirmed_true: int = 0
    confirmed_false: int = 0
    contradicted_true: int = 0
    contradicted_false: int = 0
    not_judged: int = 0


def sense_confusions(rows: Iterable[EpisodeRow]) -> tuple[SenseConfusion, ...]:
    """One matrix for each sense over the judged `rows`; rows of older results, without verdicts, are left out.

    The fact of the sense "intact" is that no object was pressed beyond its limit. The other senses are compared with
    the success of the instruction, of which each is one part: only the sense "fulfilled" claims the whole of it.
    """
    known = [row for row in rows if row.judged]
    return tuple(_confusion(column, known) for column in SENSE_COLUMNS)


def confirmed_success_confusion(rows: Iterable[EpisodeRow]) -> SenseConfusion:
    """The combined check of claimed successes: "confirmed" where the senses agree with the claim."""
    verdicts = {"agrees": "confirmed", "disagrees": "contradicted"}
    pairs = [(verdicts.get(row.second_opinion, ""), row.success) for row in rows if row.judged and row.claimed]
    return _counted("combined", pairs)


def _confusion(column: str, rows: list[EpisodeRow]) -> SenseConfusion:
    intact = column == "sense_intact"
    pairs = [
        (verdict, not has_kind(row.violations, BROKEN) if intact else row.success)
        for row in rows
        if (verdict := getattr(row, column))
    ]
    return _counted(column.removeprefix("sense_"), pairs)


def _counted(name: str, pairs: list[tuple[str, bool]]) -> SenseConfusion:
    return SenseConfusion(
        sense=name,
        confirmed_true=pairs.count(("confirmed", True)),
        confirmed_false=pairs.count(("confirmed", False)),
        contradicted_true=pairs.count(("contradicted", True)),
        contradicted_false=pairs.count(("contradicted", False)),
        not_judged=sum(verdict not in ("confirmed", "contradicted") for verdict, _ in pairs),
    )
