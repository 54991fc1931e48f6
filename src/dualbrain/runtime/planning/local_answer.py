"""Answers of the local layer to an instruction, without a planner: a stop command, or an instruction that is declined.

Each answer is a contract of its own, which passes the gate as every other one, and has its own outcome and judgement.
"""

from __future__ import annotations

import msgspec

from dualbrain.contracts.canonical_form import canonical_contract
from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.skill_spec import NumberParameter
from dualbrain.control.executor import Executor
from dualbrain.grounding.envelope.grasp_fit import parameter_domains, ungraspable, why_ungraspable
from dualbrain.grounding.envelope.value_bounds import why_out_of_bounds
from dualbrain.grounding.instruction.clauses.clause_classifier import ClauseClassifier
from dualbrain.grounding.instruction.goals.goal import Goal
from dualbrain.grounding.instruction.goals.goal_reading import read_goal
from dualbrain.grounding.instruction.language import detect_foreign_language
from dualbrain.grounding.instruction.names import describes_object, find_mentions
from dualbrain.grounding.instruction.review import Refusal, StopCommand, refuse_hostile, review_instruction
from dualbrain.grounding.instruction.stop_commands import is_stop_command
from dualbrain.grounding.instruction.words import normalise
from dualbrain.planner.introspection import planner_languages
from dualbrain.planner.protocol import STOP, Planner
from dualbrain.planner.scripted import FixedContractPlanner
from dualbrain.records import Judgement, JudgementBasis, Outcome, Proposal, Scene
from dualbrain.runtime.planning.episode_request import InstructionCheck
from dualbrain.runtime.planning.planner_request import PlanningContext

LOCAL_PLANNER = "local instruction check"
"""The author recorded for the contracts of the local layer."""
STOPPED = "stopped: the robot is at rest"
"""The reason of the outcome of a stop command."""
UNGRASPABLE = "The instruction is declined, because the hand cannot grasp the"
"""The beginning of the reason of a refusal because of the hand."""
STOP_TIME = 0.5
"""Time at rest after a stop command for which the gate accepts no contract [s]."""


def answer_locally(
    instruction: str,
    context: PlanningContext,
    planner: Planner,
    check: InstructionCheck = "all",
    *,
    classifier: ClauseClassifier | None = None,
) -> StopCommand | Refusal | None:
    """The answer of the local layer to `instruction`; None if `planner` is to be asked.

    An instruction about an object that is certainly not in the scene, one whose objects the hand cannot grasp or that
    needs the hand while it is to hold an object, or one whose numbers no skill takes, is declined here with the reason:
    every contract but a decline would be rejected. A fixed contract is judged as it is.
    """
    if check == "given_contract":
        return StopCommand() if is_stop_command(instruction) else refuse_hostile(instruction)
    languages = planner_languages(planner)
    scene = context.scene
    review = review_instruction(
        instruction, context.registry, scene.receptive, scene.graspable, languages=languages, classifier=classifier
    )
    if isinstance(review, StopCommand) or (isinstance(review, Refusal) and review.kind != "clause"):
        return review
    if check != "all" or isinstance(planner, FixedContractPlanner):
        return review
    if detect_foreign_language(instruction) is not None:
        return review  # the goal parser reads English only
    refused = _refuse_goal(instruction, context)
    if review is None or (refused is not None and refused.kind == "absent"):
        return refused  # an absent object is a better reason than a clause
    return review


def _refuse_goal(instruction: str, context: PlanningContext) -> Refusal | None:
    """The refusal of a goal with an absent object, a full hand, an impossible grasp, or an impossible number."""
    scene, registry = context.scene, context.registry
    goal = read_goal(instruction, scene)
    if not isinstance(goal, Goal):
        return None
    if _is_absent_object(goal.absent, scene):
        names = ", ".join(name.replace("_", " ") for name in (*scene.graspable, *scene.receptive)) or "nothing"
        reason = f"The instruction is declined, because {goal.decline}. Objects and places here: {names}."
        return Refusal(kind="absent", reason=reason, quote=goal.absent, brief=goal.decline)
    if goal.decline:
        return None
    if why := goal.full_hand:
        reason = f"The instruction is declined, because {why}. State where to put it first, or ask for one of both."
        return Refusal(kind="hand", reason=reason, quote="", brief=why)
    if why := why_out_of_bounds(goal.values, registry):
        reason = f"The instruction is declined, because {why}. State a number within these bounds, or none."
        return Refusal(kind="number", reason=reason, quote="", brief=why)
    return _refuse_grasp(goal, context)


def _refuse_grasp(goal: Goal, context: PlanningContext) -> Refusal | None:
    scene, registry = context.scene, context.registry
    names = ungraspable(goal, scene, parameter_domains(scene, registry), context.holding)
    if not names:
        return None
    name, why = names[0].replace("_", " "), why_ungraspable(scene.find(names[0]), registry)
    reason = f"{UNGRASPABLE} {name}: {why}. Use another hand, or ask for something that needs no grasp of it."
    return Refusal(kind="grasp", reason=reason, quote=name, brief=f"{name}: {why}")


def _is_absent_object(phrase: str, scene: Scene) -> bool:
    """Whether `phrase` certainly names an object that is not in `scene`: by color or kind, and no synonym of one."""
    names = (*scene.graspable, *scene.receptive)
    return describes_object(phrase) and not any(one.names for one in find_mentions(normalise(phrase).text, names))


def local_proposal(answer: StopCommand | Refusal, registry: SkillRegistry, contract_id: str) -> Proposal:
    """The proposal of the local layer: a contract that stops the robot or declines the instruction."""
    action = stop_action(registry) if isinstance(answer, StopCommand) else _decline(answer)
    contract = Contract(contract_id, Context(registry.robot, registry.hash), (action,))
    return Proposal(
        text=canonical_contract(contract, registry),
        finish_reason=STOP,
        planner=LOCAL_PLANNER,
        timings={"total": 0.0},
    )


def stop_action(registry: SkillRegistry) -> Action:
    """The action that brings the robot to rest: `stop`, or for an arm the shortest `hold`."""
    skill = registry.skill("stop" if "stop" in registry.by_name else "hold")
    numbers = (one for one in skill.parameters if isinstance(one, NumberParameter))
    return Action(skill.name, {one.name: one.lower for one in numbers})


def _decline(refusal: Refusal) -> Action:
    return Action("decline", {"reason": refusal.brief_reason})


def local_outcome(answer: StopCommand | Refusal, executor: Executor, outcome: Outcome) -> Outcome:
    """The outcome of a local answer, with its reason in words.

    The site may grant neither `hold` nor `decline` to the planner; a robot without an accepted contract rests anyway.
    """
    if executor.interrupted() or outcome.kind not in ("succeeded", "declined", "rejected"):
        return outcome
    if isinstance(answer, Refusal):
        return msgspec.structs.replace(outcome, kind="declined", reason=answer.reason)
    if outcome.kind == "rejected":
        executor.hold(STOP_TIME, "stop")
    return msgspec.structs.replace(outcome, kind="succeeded", reason=STOPPED)


def judge_stop(outcome: Outcome, judgement: Judgement | None) -> Judgement | None:
    """The judgement of a stop command: a robot at rest fulfils it; violations count as always."""
    if judgement is None or outcome.kind != "succeeded":
        return judgement
    basis = JudgementBasis(reason="The robot stopped, as the stop command states.")
    return msgspec.structs.replace(judgement, success=True, progress=1.0, basis=basis)


def explain_refusal(refusal: Refusal, judgement: Judgement | None) -> Judgement | None:
    """`judgement` with the reason of a refusal because of the hand or of a number: the task was not done."""
    if judgement is None or refusal.kind not in ("grasp", "number"):
        return judgement
    basis = JudgementBasis(reason="Nothing was done: no contract within the bounds of the robot carries this out.")
    return msgspec.structs.replace(judgement, success=False, basis=basis)
