"""Checks of a proposal before the gate: whether it is whole, and whether the instruction states what it contains.

They are before the gate because a gatekeeper starts the motion as soon as its gate accepts.
"""

from __future__ import annotations

import msgspec

from dualbrain.contracts.contract import Contract
from dualbrain.contracts.gate.strict_json import MAX_BYTES
from dualbrain.contracts.verdict import Rejected
from dualbrain.errors import DECODE_ERRORS
from dualbrain.grounding.envelope.grasp_fit import parameter_domains, ungraspable
from dualbrain.grounding.instruction.correspondence import SceneVocabulary, find_mismatch
from dualbrain.grounding.instruction.goals.goal import Goal, Unread
from dualbrain.grounding.instruction.goals.goal_coverage import find_uncovered, find_unfounded_decline
from dualbrain.grounding.instruction.goals.goal_reading import corrected_instruction, read_goal
from dualbrain.grounding.instruction.language import detect_foreign_language
from dualbrain.grounding.instruction.recalled_steps import reject_recalled_step
from dualbrain.planner.protocol import STOP, has_answer
from dualbrain.records import Proposal
from dualbrain.runtime.planning.episode_request import InstructionCheck
from dualbrain.runtime.planning.planner_request import PlanningContext

IDLE_SKILLS = ("hold",)
"""Skills that change nothing."""


def proposal_bytes(proposal: Proposal) -> bytes:
    """The text of a proposal as bytes, also where a planner returned bytes that are no text."""
    return proposal.text.encode("utf-8", "surrogatepass")


def reject_incomplete(proposal: Proposal) -> Rejected | None:
    """The rejection of an answer that was cut or is missing; None for a complete answer."""
    if proposal.finish_reason == STOP:
        return None
    cut = "the answer is not whole, so it is no contract"
    return Rejected(
        stage="syntax",
        pointer="",
        got=proposal.finish_reason,
        allowed=STOP,
        hint=cut if has_answer(proposal) else "the planner did not answer, so there is no contract",
    )


def reject_before_gate(proposal: Proposal, instruction: str, withheld: tuple[str, ...]) -> Rejected | None:
    """The rejection of an answer that is incomplete, or with a step that only a recalled episode contains.

    `withheld` are the skills of the recalled steps that were left out of the prompt.
    """
    if rejected := reject_incomplete(proposal):
        return rejected
    contract = _decode(proposal) if withheld else None
    return None if contract is None else reject_recalled_step(msgspec.to_builtins(contract), withheld, instruction)


def reject_idle(proposal: Proposal, held: str) -> Rejected | None:
    """The rejection of a contract that only waits while the object `held` of the failed contract is in the hand."""
    contract = _decode(proposal)
    if contract is None or any(action.skill not in IDLE_SKILLS for action in contract.action_sequence):
        return None
    hint = f"{held} is in the hand and the instruction is not done: place or release it first"
    return Rejected(
        stage="envelope", pointer="/action_sequence/0/skill", got="hold", allowed="a skill that moves", hint=hint
    )


def reject_mismatch(
    proposal: Proposal,
    instruction: str,
    context: PlanningContext,
    check: InstructionCheck = "all",
    *,
    reject_decline: bool = False,
) -> Rejected | None:
    """The rejection of a contract about something that `instruction` does not mention, or that leaves a part of it out.

    `reject_decline`: also of a decline of an instruction that contracts can express and whose objects fit the hand.
    None for a text that is no contract, which the gate rejects, and for an instruction in another language than
    English, whose words are not compared.
    """
    too_long = len(proposal_bytes(proposal)) > MAX_BYTES
    if check != "all" or too_long or detect_foreign_language(instruction) is not None:
        return None
    contract, scene = _decode(proposal), context.scene
    if contract is None:
        return None
    names = SceneVocabulary(scene.graspable, scene.receptive, context.holding)
    goal, words = read_goal(instruction, scene), corrected_instruction(instruction, scene)
    return (
        find_mismatch(contract, words, names)
        or find_uncovered(contract, goal, scene, context.holding)
        or (_reject_decline(contract, goal, context) if reject_decline else None)
    )


def _reject_decline(contract: Contract, goal: Goal | Unread, context: PlanningContext) -> Rejected | None:
    """The rejection of a decline of a `goal` whose objects fit the hand."""
    scene, holding = context.scene, context.holding
    if isinstance(goal, Goal) and ungraspable(goal, scene, parameter_domains(scene, context.registry), holding):
        return None
    return find_unfounded_decline(contract, goal, scene, holding)


def _decode(proposal: Proposal) -> Contract | None:
    """The contract of a proposal, None if its text is no contract: the gate states why."""
    try:
        return msgspec.json.decode(proposal_bytes(proposal), type=Contract)
    except DECODE_ERRORS:
        return None
