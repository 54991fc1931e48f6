"""Check of an outcome by independent senses of the robot: perception, finger forces, opening and joint encoders.

Each sense is one module and returns a `SenseVerdict`. No sense uses the skills' own verdict, the planner, or simulator
ground truth. Memory accepts a success only if the senses confirm it (`combine_verdicts`).
"""

from __future__ import annotations

from dataclasses import dataclass

from dualbrain.contracts.contract import Contract
from dualbrain.grounding.instruction.goals.goal import Goal, Unread
from dualbrain.grounding.instruction.goals.goal_reading import read_goal
from dualbrain.grounding.outcome.changes_in_words import describe_changes
from dualbrain.grounding.outcome.evidence import Array, Evidence, arm_home, base_position
from dualbrain.grounding.outcome.sense_fulfilled import NAME as FULFILLED
from dualbrain.grounding.outcome.sense_fulfilled import judge_fulfilled
from dualbrain.grounding.outcome.sense_held import judge_held
from dualbrain.grounding.outcome.sense_intact import NAME as INTACT
from dualbrain.grounding.outcome.sense_intact import judge_intact
from dualbrain.grounding.outcome.sense_placed import NAME as PLACED
from dualbrain.grounding.outcome.sense_placed import judge_placed
from dualbrain.grounding.outcome.sense_undisturbed import judge_undisturbed
from dualbrain.records import Outcome, OutcomeCheck, Scene, SenseVerdict
from dualbrain.robots.model import RobotModel

SENSES = ("placed", "intact", "held", "undisturbed", "fulfilled")
"""Names of the senses, in the order of their verdicts."""
COMPLETED = ("succeeded", "paused", "slowed")
"""Outcomes that claim that the contract was carried out to its end."""


@dataclass(frozen=True, slots=True)
class CheckedOutcome:
    """The verdicts of all senses, the changes in words, and the check of the reported outcome that follows."""

    verdicts: tuple[SenseVerdict, ...]
    changes: str
    check: OutcomeCheck


def check_outcome(instruction: str, outcome: Outcome, contract: Contract | None, evidence: Evidence) -> CheckedOutcome:
    """All senses on `evidence`, and whether they agree with the reported `outcome`.

    Without an instruction (a given contract) there is no request to compare with; the contract is then the request.
    """
    goal = read_goal(instruction, evidence.before) if instruction.strip() else Unread("There is no instruction.")
    asked = goal.movable if isinstance(goal, Goal) else frozenset[str]()
    handled = handled_objects(contract, evidence.held_at_start) | asked
    verdicts = (
        judge_placed(evidence),
        judge_intact(evidence),
        judge_held(evidence),
        judge_undisturbed(evidence, handled),
        judge_fulfilled(goal, evidence),
    )
    check = combine_verdicts(outcome, verdicts, gripped=bool(evidence.all_grips), instructed=bool(instruction.strip()))
    return CheckedOutcome(verdicts, describe_changes(evidence), check)


def combine_verdicts(
    outcome: Outcome, verdicts: tuple[SenseVerdict, ...], *, gripped: bool, instructed: bool = True
) -> OutcomeCheck:
    """Whether the senses agree with the reported outcome; "none" if they do not decide.

    A success agrees if the request is confirmed, no sense contradicts, and every gripped object is confirmed intact. A
    failure agrees if the request is contradicted, and disagrees if it is confirmed. Without an instruction the sense
    "placed" replaces the request.
    """
    by_name = {one.sense: one.verdict for one in verdicts}
    request = by_name.get(FULFILLED if instructed else PLACED, "not judged")
    contradicted = any(verdict == "contradicted" for verdict in by_name.values())
    if outcome.kind in COMPLETED:
        if contradicted:
            return "disagrees"
        intact = by_name.get(INTACT) == "confirmed" or not gripped
        return "agrees" if request == "confirmed" and intact else "none"
    if outcome.kind in ("failed", "taken_over"):
        if request == "confirmed" and not contradicted:
            return "disagrees"
        return "agrees" if request == "contradicted" else "none"
    return "none"


def collect_evidence(
    before: Scene,
    after: Scene,
    contract: Contract | None,
    outcome: Outcome,
    q_before: Array,
    q_after: Array,
    robot_model: RobotModel,
    *,
    held: str | None = None,
) -> Evidence:
    """The evidence of one contract; `q_before`, `q_after` (nq,) [rad, m] are measured joint positions.

    `held` is the object in the hand when the contract began.
    """
    grips = outcome.grips
    in_hand = grips[-1].object_name if grips and grips[-1].holds_at_end else ""
    return Evidence(
        before=before,
        after=after,
        q_before=q_before,
        q_after=q_after,
        home=arm_home(robot_model),
        base_after=base_position(robot_model, q_after),
        declined=outcome.kind == "declined",
        executed=tuple(action.skill for action in contract.action_sequence) if contract else (),
        placements=expected_placements(contract, held),
        grips=grips,
        in_hand=in_hand,
        in_hand_before=held or "",
        held_at_start=held or "",
    )


def expected_placements(contract: Contract | None, held: str | None = None) -> dict[str, str]:
    """The last destination of each object that the contract places: grasped by it, or `held` when it began."""
    obj = held or None
    found: dict[str, str] = {}
    for action in contract.action_sequence if contract else ():
        if action.skill == "grasp":
            obj = str(action.params["object"])
            found.pop(obj, None)
        elif action.skill == "place" and obj is not None:
            found[obj], obj = str(action.params["destination"]), None
    return found


def handled_objects(contract: Contract | None, held: str | None = None) -> frozenset[str]:
    """The objects that the contract grasps or pushes, and the object `held` when it began."""
    actions = contract.action_sequence if contract else ()
    handled = frozenset(str(one.params["object"]) for one in actions if one.skill in ("grasp", "push"))
    return handled | {held} if held else handled


def fulfilled_verdict(verdicts: tuple[SenseVerdict, ...]) -> SenseVerdict | None:
    """The verdict on whether the request was carried out."""
    return next((one for one in verdicts if one.sense == FULFILLED), None)
