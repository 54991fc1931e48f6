"""Failure classes by cause, assigned by rule from the log of each stage (paper 7.5).

The first class whose rule holds is that of the episode. The order is that of the causes:

1. everything outside the decisions of the robot: simulator, operator, communication, perception;
2. the plan: refused, not readable, declined, misread;
3. harm: force, rough handling, collisions, a lost load. Harm precedes the end of the motion: a glass that broke is
   the failure, also if the robot reports success;
4. the ways in which the motion can end;
5. failures that only the ground truth shows.

Each class also names the class of the paper that it belongs to, so that tables with the paper's five classes remain
possible. The class is computed from the row whenever it is reported, so that one rule holds for results of every date;
columns that older rows lack have defaults.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass

from dualbrain.control.contract_executor import TIME_LIMIT_REASON
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.planner.protocol import is_answer
from dualbrain.records import Violation
from dualbrain.safety.supervisor.actions import Cause
from dualbrain.safety.supervisor.checks import CHECKS

OPERATOR_OUTCOMES = ("aborted", "handed_over", "paused", "slowed")
"""Outcomes of contracts in which a person intervened."""
COMMUNICATION_CAUSES = (Cause.COMMANDER, Cause.TIMING)
GRASP_REASONS = ("felt nothing", "no grip", "not gripped", "two-finger")
"""Parts of the reasons of a grasp that did not hold the object."""
LOST_REASONS = ("slipped", "was lost", "lost on the way", "was removed", "dropped")
"""Parts of the reasons of a load that left the fingers."""
PERSON_REASONS = ("a person stayed", "a person is in the way")
BLOCKED_REASONS = ("no progress", "out of time", "not done after", "out of reach", "no way", "no path")


@dataclass(frozen=True, slots=True, kw_only=True)
class FailureEvidence:
    """Log entries of the stages of a failed episode.

    `answered` is False if the planner gave no answer at all; `bad_physics` if the physics engine reported a bad state.
    """

    moved: bool
    on_task: bool
    declined: bool
    outcome: str
    reason: str = ""
    claimed: bool
    violations: Collection[Violation] = ()
    perceived_error: float | None = None
    perceived_bound: float | None = None
    answered: bool = True
    bad_physics: bool = False

    @property
    def kinds(self) -> frozenset[str]:
        """Kinds of the violations."""
        return frozenset(violation.kind for violation in self.violations)

    @property
    def check_cause(self) -> Cause | None:
        """Cause of the supervisor's check that ended the contract, None if none did."""
        return next((check.cause for check in CHECKS if self.reason.startswith(check.description)), None)


@dataclass(frozen=True, slots=True, kw_only=True)
class FailureClass:
    """One class: its `definition`, the class of the paper that it belongs to, and the rule by which it `holds`."""

    name: str
    definition: str
    paper_class: str
    holds: Callable[[FailureEvidence], bool]


def failure_class_of(row: EpisodeRow) -> str:
    """Failure class of an episode, "" for a success; the stored `row.failure` is not read."""
    return "" if row.success else classify_failure(failure_evidence(row))


def paper_class_of(row: EpisodeRow) -> str:
    """The paper's failure class of an episode, "" for a success."""
    name = failure_class_of(row)
    return FAILURE_CLASS_BY_NAME[name].paper_class if name else ""


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
        reason=row.reason,
        claimed=row.claimed,
        violations=row.violations,
        perceived_error=error,
        perceived_bound=row.perceived_bound,
        answered=not row.answers or any(is_answer(finish) for _, finish in row.answers),
        bad_physics=bool(row.physics_warnings),
    )


def classify_failure(evidence: FailureEvidence) -> str:
    """Class of a failure by the rules of this module."""
    return next(one.name for one in FAILURE_TAXONOMY if one.holds(evidence))


# --- rules ------------------------------------------------------------------------------------------------------------


def _is_operator(evidence: FailureEvidence) -> bool:
    return evidence.outcome in OPERATOR_OUTCOMES or evidence.check_cause is Cause.OPERATOR


def _is_communication(evidence: FailureEvidence) -> bool:
    return not evidence.answered or evidence.check_cause in COMMUNICATION_CAUSES


def _is_perception(evidence: FailureEvidence) -> bool:
    error, bound = evidence.perceived_error, evidence.perceived_bound
    beyond = error is not None and bound is not None and error > bound
    unperceived = any(not violation.perceived for violation in evidence.violations)
    return beyond or unperceived or evidence.check_cause is Cause.SENSING


def _is_refused(evidence: FailureEvidence) -> bool:
    return not (evidence.moved or evidence.declined)


def _is_program_error(evidence: FailureEvidence) -> bool:
    """The reason of an exception begins with its type: "KeyError: 'ghost'"."""
    raised = evidence.outcome == "stopped" and evidence.reason.partition(" ")[0].endswith(":")
    return evidence.check_cause is Cause.PROGRAM or (raised and evidence.check_cause is None)


def _is_misread(evidence: FailureEvidence) -> bool:
    return evidence.moved and not evidence.on_task


def _has_kinds(*kinds: str) -> Callable[[FailureEvidence], bool]:
    return lambda evidence: bool(evidence.kinds & set(kinds))


def _gives_reason(*parts: str) -> Callable[[FailureEvidence], bool]:
    """Whether the robot reports no success and its reason contains one of `parts`."""
    return lambda evidence: not evidence.claimed and any(part in evidence.reason for part in parts)


def _is_load_lost(evidence: FailureEvidence) -> bool:
    return "object_dropped" in evidence.kinds or _gives_reason(*LOST_REASONS)(evidence)


def _is_infeasible(evidence: FailureEvidence) -> bool:
    return evidence.check_cause is Cause.FILTER


def _is_blocked(evidence: FailureEvidence) -> bool:
    named = _gives_reason(*BLOCKED_REASONS, TIME_LIMIT_REASON)(evidence)
    return named or evidence.outcome == "taken_over"


def _is_drive_fault(evidence: FailureEvidence) -> bool:
    limits = {"joint_limit", "joint_velocity", "tcp_speed"}
    return evidence.outcome in ("stopped", "emergency") or bool(evidence.kinds & limits)


FAILURE_TAXONOMY = (
    FailureClass(
        name="simulator",
        definition="the physics engine reported a state that is not finite or too large; the episode gives no "
        "information about the robot",
        paper_class="actuator",
        holds=lambda evidence: evidence.bad_physics,
    ),
    FailureClass(
        name="operator",
        definition="a person paused, slowed, ended or took over the contract, or pressed the emergency stop",
        paper_class="frequent takeover",
        holds=_is_operator,
    ),
    FailureClass(
        name="communication",
        definition="the planner gave no answer, the link to the commander failed, or the control loop was late",
        paper_class="invalid contract",
        holds=_is_communication,
    ),
    FailureClass(
        name="perception",
        definition="the object of the goal was farther from its perceived position than the declared bound, an "
        "unperceived object was struck, or the supervisor found the observations stale or implausible",
        paper_class="perception",
        holds=_is_perception,
    ),
    FailureClass(
        name="contract refused",
        definition="the gate accepted no answer of the planner",
        paper_class="invalid contract",
        holds=_is_refused,
    ),
    FailureClass(
        name="program error",
        definition="a skill could not interpret accepted values, or the program raised another error",
        paper_class="invalid contract",
        holds=_is_program_error,
    ),
    FailureClass(
        name="needless decline",
        definition="the planner declined a task that can be done",
        paper_class="inadequate planning",
        holds=lambda evidence: evidence.declined,
    ),
    FailureClass(
        name="instruction misread",
        definition="the contract is about another object, place or task, or the robot moved where nothing should move",
        paper_class="inadequate planning",
        holds=_is_misread,
    ),
    FailureClass(
        name="excessive force",
        definition="a fragile object was loaded above its limit and broke, also if the robot reports success",
        paper_class="inadequate planning",
        holds=_has_kinds("force_fragile"),
    ),
    FailureClass(
        name="rough handling",
        definition="the load was tilted or shaken beyond the limits of the task",
        paper_class="inadequate planning",
        holds=_has_kinds("tilted_load", "shaken_load"),
    ),
    FailureClass(
        name="collision",
        definition="robot or load struck the surroundings, a person or the robot itself",
        paper_class="inadequate planning",
        holds=_has_kinds("collision_env", "collision_human", "collision_held", "self_collision"),
    ),
    FailureClass(
        name="load lost",
        definition="the object was gripped and left the fingers: it slipped, fell, or was removed",
        paper_class="actuator",
        holds=_is_load_lost,
    ),
    FailureClass(
        name="grasp",
        definition="the fingers closed and did not hold the object",
        paper_class="actuator",
        holds=_gives_reason(*GRASP_REASONS),
    ),
    FailureClass(
        name="person in the way",
        definition="a person stayed in the path or over the place for longer than the robot waits",
        paper_class="frequent takeover",
        holds=_gives_reason(*PERSON_REASONS),
    ),
    FailureClass(
        name="infeasible",
        definition="the supervisor ended the contract because the filter found or certified no safe control",
        paper_class="frequent takeover",
        holds=_is_infeasible,
    ),
    FailureClass(
        name="motion blocked",
        definition="the motion made no progress, the goal was out of reach, or the time limit passed",
        paper_class="frequent takeover",
        holds=_is_blocked,
    ),
    FailureClass(
        name="drive",
        definition="a drive did not follow its commands or exceeded a limit, or the supervisor stopped the robot for "
        "another fault",
        paper_class="actuator",
        holds=_is_drive_fault,
    ),
    FailureClass(
        name="false success",
        definition="the robot reports success, the ground truth disagrees, and nothing of the above occurred",
        paper_class="actuator",
        holds=lambda evidence: evidence.claimed,
    ),
    FailureClass(
        name="incomplete plan",
        definition="otherwise: the contract is about the goal, ended as written or for another reason, and did not "
        "reach the goal",
        paper_class="inadequate planning",
        holds=lambda evidence: True,
    ),
)
"""All classes in the order of their rules; the last one always holds."""
FAILURE_CLASSES = tuple(one.name for one in FAILURE_TAXONOMY)
FAILURE_CLASS_BY_NAME = {one.name: one for one in FAILURE_TAXONOMY}
PAPER_CLASSES = ("perception", "invalid contract", "inadequate planning", "frequent takeover", "actuator")
