"""Failure classes: the paper's five, assigned by rule from the log of each stage (paper 7.5).

The first rule that holds gives the class. The order of the rules is that of the stages:

1. `perception`: the position error of the goal's object exceeded the declared bound, or an object was struck that had
   not been perceived;
2. `invalid contract`: the gate accepted no answer, or a skill could not read the values of an accepted contract (a
   program error on these values);
3. `inadequate planning`: a feasible task was declined, the contract is about something else, or the robot moved an
   object where nothing should move;
4. `frequent takeover`: the safety layer ended the contract, or the filter changed more than `TAKEOVER_FREQUENCY` of
   its ticks;
5. `actuator`: the motion itself failed: a drive or program fault, a dropped object, a grasp that slipped, or a contract
   that the robot reports as done although the ground truth disagrees and no harm was caused;
6. otherwise `inadequate planning`: a contract that is about the goal and was executed as written, but does not reach
   the goal in time or causes harm, by the force that it requests or on the way that it takes.

The class is computed from the row whenever it is reported, so that one rule holds for results of every date.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from dualbrain.control.contract_executor import TIME_LIMIT_REASON
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.records import Violation

FAILURE_CLASSES = ("perception", "invalid contract", "inadequate planning", "frequent takeover", "actuator")
TAKEOVER_FREQUENCY = 0.5
"""Share of ticks with δ above the dead band beyond which the filter, not the plan, controlled the robot."""
CONTRACT_CAUSED_VIOLATIONS = {
    "force_fragile",
    "collision_env",
    "collision_human",
    "collision_held",
    "shaken_load",
    "tilted_load",
}
"""Kinds of violations that a contract can cause by its parameters."""
GRASPED_PROGRESS = 0.5
"""Progress from which on the object was grasped."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FailureEvidence:
    """Log entries of the stages of a failed episode."""

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
    """Failure class of an episode, "" for a success; the stored `row.failure` is not read."""
    return "" if row.success else classify_failure(failure_evidence(row))


def failure_evidence(row: EpisodeRow) -> FailureEvidence:
    """Log entries of the stages of the episode of `row`.

    The error of an object that was not perceived at all is infinite. JSON has no such number, so a row stores it as a
    bound without an error.
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
    """Whether a skill could not interpret values that the gate had accepted."""
    return row.outcome == "stopped" and ":" in row.reason.partition(" ")[0]


def classify_failure(evidence: FailureEvidence) -> str:
    """Class of a failure by the rules of this module."""
    for name, holds in _RULES:
        if holds(evidence):
            return name
    return "inadequate planning"


def _is_perception_failure(evidence: FailureEvidence) -> bool:
    error, bound = evidence.perceived_error, evidence.perceived_bound
    beyond = error is not None and bound is not None and error > bound
    return beyond or any(not violation.perceived for violation in evidence.violations)


def _is_invalid_contract(evidence: FailureEvidence) -> bool:
    return evidence.unreadable or not (evidence.moved or evidence.declined)


def _is_off_task(evidence: FailureEvidence) -> bool:
    return evidence.declined or not evidence.on_task


def _is_frequent_takeover(evidence: FailureEvidence) -> bool:
    return evidence.outcome == "taken_over" or evidence.frequency > TAKEOVER_FREQUENCY


def _is_actuator_failure(evidence: FailureEvidence) -> bool:
    kinds = {violation.kind for violation in evidence.violations}
    false_claim = evidence.claimed and not kinds & CONTRACT_CAUSED_VIOLATIONS
    slipped = evidence.outcome == "failed" and evidence.progress >= GRASPED_PROGRESS and not evidence.out_of_time
    return evidence.outcome in ("stopped", "emergency") or "object_dropped" in kinds or false_claim or slipped


_RULES = (
    ("perception", _is_perception_failure),
    ("invalid contract", _is_invalid_contract),
    ("inadequate planning", _is_off_task),
    ("frequent takeover", _is_frequent_takeover),
    ("actuator", _is_actuator_failure),
)
