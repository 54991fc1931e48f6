"""Failure classes by cause, assigned by rule from the log of each stage (paper 7.5).

The first class whose rule holds is that of the episode. The order is that of the causes:

1. everything outside the decisions of the robot: simulator, operator, communication, perception;
2. the plan: refused, not readable, declined (rightly because of the hand, or needlessly), misread;
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
from dualbrain.evaluation.analysis.violation_kinds import BROKEN, DROPPED, TOOL_SPEED, has_kind, violation_kinds
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.planner.protocol import is_answer
from dualbrain.records import FailureCause, Violation
from dualbrain.runtime.planning.local_answer import UNGRASPABLE
from dualbrain.safety.supervisor.actions import Cause
from dualbrain.safety.supervisor.checks import CHECKS

OPERATOR_OUTCOMES = ("aborted", "handed_over", "paused", "slowed")
"""Outcomes of contracts in which a person intervened."""
COMMUNICATION_CAUSES = (Cause.COMMANDER, Cause.TIMING)
REASON_PARTS: dict[FailureCause, tuple[str, ...]] = {
    FailureCause.NOT_GRIPPED: ("felt nothing", "no grip", "not gripped", "two-finger", "slips out of"),
    FailureCause.LOAD_SLIPPED: ("slipped",),
    FailureCause.LOAD_LOST: ("was lost", "was removed", "dropped"),
    FailureCause.PERSON: ("a person stayed", "a person is in the way"),
    FailureCause.NO_PROGRESS: ("no progress", TIME_LIMIT_REASON, "not done after"),
    FailureCause.OUT_OF_REACH: ("out of reach", "no way", "no path"),
    FailureCause.PRECONDITION: (
        "nothing is held",
        "already holding",
        "than the push is long",
        "the longest push",
        "is no place on the map",
    ),
    FailureCause.GOAL_MISSED: ("after letting go", "after the drive", " cm toward ", "did not open"),
}
"""Parts of the reason of a failed skill by its cause, for rows without a cause: those of earlier versions, and those of
a contract that ended at the time limit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FailureEvidence:
    """Log entries of the stages of a failed episode.

    `cause` is the `FailureCause` of a failed skill, "" if it is not recorded. `answered` is False if the planner gave
    no answer at all; `bad_physics` if the physics engine reported a bad state.
    """

    moved: bool
    on_task: bool
    declined: bool
    outcome: str
    reason: str = ""
    cause: str = ""
    claimed: bool
    violations: Collection[Violation] = ()
    perceived_error: float | None = None
    perceived_bound: float | None = None
    answered: bool = True
    bad_physics: bool = False

    @property
    def kinds(self) -> frozenset[str]:
        """Kinds of the violations."""
        return violation_kinds(self.violations)

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
        cause=row.failure_cause,
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
    return lambda evidence: has_kind(evidence.violations, *kinds)


def _has_cause(*causes: FailureCause) -> Callable[[FailureEvidence], bool]:
    """Whether the robot reports no success, for one of `causes`."""
    parts = [part for cause in causes for part in REASON_PARTS[cause]]

    def holds(evidence: FailureEvidence) -> bool:
        if evidence.claimed:
            return False
        return evidence.cause in causes if evidence.cause else any(part in evidence.reason for part in parts)

    return holds


def _is_load_lost(evidence: FailureEvidence) -> bool:
    lost = _has_cause(FailureCause.LOAD_LOST, FailureCause.LOAD_SLIPPED)
    return has_kind(evidence.violations, DROPPED) or lost(evidence)


def _is_infeasible(evidence: FailureEvidence) -> bool:
    return evidence.check_cause is Cause.FILTER


def _is_blocked(evidence: FailureEvidence) -> bool:
    blocked = _has_cause(FailureCause.NO_PROGRESS, FailureCause.OUT_OF_REACH)
    return blocked(evidence) or evidence.outcome == "taken_over"


def _is_drive_fault(evidence: FailureEvidence) -> bool:
    limits = has_kind(evidence.violations, "joint_limit", "joint_velocity", TOOL_SPEED)
    return evidence.outcome in ("stopped", "emergency") or limits


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
        name="beyond the hand",
        definition="the instruction was declined, because the hand cannot grasp the object or presses harder than "
        "it bears",
        paper_class="actuator",
        holds=lambda evidence: evidence.declined and evidence.reason.startswith(UNGRASPABLE),
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
        holds=_has_kinds(BROKEN),
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
        definition="the object was gripped and slipped in the fingers, or left them: it fell, or was removed",
        paper_class="actuator",
        holds=_is_load_lost,
    ),
    FailureClass(
        name="grasp",
        definition="the fingers closed and did not hold the object",
        paper_class="actuator",
        holds=_has_cause(FailureCause.NOT_GRIPPED),
    ),
    FailureClass(
        name="person in the way",
        definition="a person stayed in the path or over the place for longer than the robot waits",
        paper_class="frequent takeover",
        holds=_has_cause(FailureCause.PERSON),
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
        name="unmet precondition",
        definition="an action began in a state that does not allow it: an object in the hand before a grasp or a push, "
        "none before a place, a place that is not on the map",
        paper_class="inadequate planning",
        holds=_has_cause(FailureCause.PRECONDITION),
    ),
    FailureClass(
        name="goal missed",
        definition="the motion ended, and by perception the object or the robot is not at the goal",
        paper_class="actuator",
        holds=_has_cause(FailureCause.GOAL_MISSED),
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
