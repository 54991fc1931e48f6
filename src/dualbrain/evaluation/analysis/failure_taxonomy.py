"""Why an episode failed: the paper's five classes, by rule, from what each stage logged (paper 7.5).

The first rule that holds gives the class; the order is that of the stages:

1. `perception`: the goal's thing lay farther from where it was perceived than the declared bound, or a thing that was
   not perceived was struck;
2. `invalid contract`: no answer passed the door, or what passed could not be read by a skill (a program error on its
   values);
3. `inadequate planning`: a decline of what can be done, a contract about something else, or anything moved where
   nothing should;
4. `frequent takeover`: the local layer ended the contract, or changed more than `TAKEOVER` of its ticks;
5. `actuator`: the motion itself went wrong: a drive or program fault, a thing dropped, a grasp that slipped, or a
   contract that the robot holds to be done and truth does not, though it harmed nothing;
6. else `inadequate planning`: a contract that was about the goal, was carried out as written, and does not lead there
   (in time), or harms something on the way: by the force it asks for, or along the way it takes.

A class is worked out from the row whenever it is told, so that one rule holds for flights of every date.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from dualbrain.control.contract_executor import TIME_LIMIT_REASON
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.records import Violation

FAILURE_CLASSES = ("perception", "invalid contract", "inadequate planning", "frequent takeover", "actuator")
TAKEOVER_FREQUENCY = 0.5
"""Share of ticks with δ above the dead band from which on the filter, not the plan, was in charge."""
CONTRACT_CAUSED_VIOLATIONS = {
    "force_fragile",
    "collision_env",
    "collision_human",
    "collision_held",
    "shaken_load",
    "tilted_load",
}
"""Kinds of violations that a contract brings about by what it asks for."""
GRASPED_PROGRESS = 0.5
"""Progress from which on the thing was in the hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FailureEvidence:
    """What the stages of a failed episode logged."""

    moved: bool
    on_task: bool
    declined: bool
    outcome: str
    claimed: bool
    frequency: float
    progress: float
    violations: Collection[Violation]
    perceived_error: float | None
    perceived_bound: float | None
    unreadable: bool
    out_of_time: bool


def failure_class_of(row: EpisodeRow) -> str:
    """The class of an episode's failure, "" for a success; what `row.failure` says is not read."""
    return "" if row.success else classify_failure(failure_evidence(row))


def failure_evidence(row: EpisodeRow) -> FailureEvidence:
    """What the stages of the episode of `row` logged.

    A thing that was not perceived at all lies infinitely far from where it was perceived; JSON has no such number, so
    that a bound without an error stands for it.
    """
    error = float("inf") if row.perceived_error is None and row.perceived_bound is not None else row.perceived_error
    return FailureEvidence(
        moved=bool(row.contract) and not row.declined,
        on_task=row.meant,
        declined=row.declined,
        outcome=row.outcome,
        claimed=row.claimed,
        frequency=row.frequency or 0.0,
        progress=row.progress,
        violations=row.violations,
        perceived_error=error,
        perceived_bound=row.perceived_bound,
        unreadable=_is_unreadable(row),
        out_of_time=row.reason.startswith(TIME_LIMIT_REASON),
    )


def _is_unreadable(row: EpisodeRow) -> bool:
    """Whether a skill could not make sense of values that the door let through."""
    return row.outcome == "stopped" and ":" in row.reason.partition(" ")[0]


def classify_failure(evidence: FailureEvidence) -> str:
    """The class of a failure."""
    for name, holds in _RULES:
        if holds(evidence):
            return name
    return "inadequate planning"


def _is_perception_failure(seen: FailureEvidence) -> bool:
    error, bound = seen.perceived_error, seen.perceived_bound
    beyond = error is not None and bound is not None and error > bound
    return beyond or any(not violation.perceived for violation in seen.violations)


def _is_actuator_failure(seen: FailureEvidence) -> bool:
    kinds = {violation.kind for violation in seen.violations}
    astray = seen.claimed and not kinds & CONTRACT_CAUSED_VIOLATIONS
    slipped = seen.outcome == "failed" and seen.progress >= GRASPED_PROGRESS and not seen.out_of_time
    return seen.outcome in ("stopped", "emergency") or "object_dropped" in kinds or astray or slipped


_RULES = (
    ("perception", _is_perception_failure),
    ("invalid contract", lambda seen: seen.unreadable or not (seen.moved or seen.declined)),
    ("inadequate planning", lambda seen: seen.declined or not seen.meant),
    ("frequent takeover", lambda seen: seen.outcome == "taken_over" or seen.frequency > TAKEOVER_FREQUENCY),
    ("actuator", _is_actuator_failure),
)
