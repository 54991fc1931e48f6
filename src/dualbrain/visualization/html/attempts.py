"""The tries of one instruction in a run report: a table of all of them, and their numbers together."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from dualbrain.contracts.contract import action_in_words
from dualbrain.records import Episode, Outcome
from dualbrain.visualization.html.key_numbers import format_dimensionless, format_millimetres, format_seconds
from dualbrain.visualization.html.page import Html, badge, section, table

STATUS_TONES = {
    "succeeded": "good",
    "failed": "bad",
    "taken_over": "warn",
    "rejected": "warn",
    "declined": "quiet",
    "aborted": "warn",
    "paused": "warn",
    "slowed": "warn",
    "handed_over": "warn",
    "emergency": "bad",
    "stopped": "bad",
    "done": "good",
    "not_run": "quiet",
}
"""Tone of the badge of each outcome and status."""


def attempts_section(episodes: Sequence[Episode]) -> Html:
    """Table of all tries in their order; nothing for a single one."""
    if len(episodes) < 2:
        return Html("")
    rows = [_row(number, one) for number, one in enumerate(episodes, start=1)]
    head = ("", "contract", "outcome", "reason", "Δ", "h_min [mm]", "motion [s]")
    note = "another contract is planned after one that failed; the numbers above cover all of them"
    return section("Tries", table(head, rows, right_aligned=(4, 5, 6)), note=note)


def combine(episodes: Sequence[Episode]) -> Episode:
    """The last episode with the numbers of all tries: Δ over all ticks, extrema, durations and planning times."""
    *_, last = episodes
    if len(episodes) == 1:
        return last
    moved = [one.outcome for one in episodes if one.outcome.Delta is not None]
    duration = sum(one.duration for one in moved)
    clearances = [one.h_min for one in moved if one.h_min is not None]
    outcome = msgspec.structs.replace(
        last.outcome,
        Delta=_mean(moved, "Delta"),
        delta_peak=max((one.delta_peak for one in moved), default=0.0),
        intervention_frequency=_mean(moved, "intervention_frequency") or 0.0,
        h_min=min(clearances, default=None),
        duration=duration,
    )
    planned = sum(one.timings.get("planner", 0.0) for one in episodes)
    return msgspec.structs.replace(last, outcome=outcome, timings=last.timings | {"planner": planned})


def _mean(outcomes: Sequence[Outcome], name: str) -> float | None:
    """Mean of a number over the motion of all outcomes; None without motion."""
    duration = sum(one.duration for one in outcomes)
    if not outcomes or not duration:
        return getattr(outcomes[-1], name) if outcomes else None
    return sum(getattr(one, name) * one.duration for one in outcomes) / duration


def _row(number: int, episode: Episode) -> Sequence[str]:
    outcome = episode.outcome
    sequence = (episode.contract or {}).get("action_sequence", [])
    steps = " → ".join(action_in_words(one.get("skill"), one.get("params", {})) for one in sequence)
    return (
        str(number),
        steps or "none was accepted",
        badge(outcome.kind.replace("_", " "), STATUS_TONES[outcome.kind]),
        outcome.reason,
        format_dimensionless(outcome.Delta),
        format_millimetres(outcome.h_min),
        format_seconds(outcome.duration),
    )
