"""Answers of the local layer to an instruction, before and after the planner.

Before: a stop command and an instruction that is declined get a contract of their own, and no planner is asked. After:
a proposal about something that the instruction does not mention is rejected before the gate sees it.
"""

from __future__ import annotations

from typing import Literal

import msgspec

from dualbrain.contracts.canonical_form import canonical_contract
from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.contracts.gate.strict_json import MAX_BYTES
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.skill_spec import NumberParameter
from dualbrain.contracts.verdict import Rejected
from dualbrain.errors import DECODE_ERRORS
from dualbrain.grounding.instruction.correspondence import SceneVocabulary, find_mismatch
from dualbrain.grounding.instruction.language import detect_foreign_language
from dualbrain.grounding.instruction.review import Refusal, StopCommand, refuse_hostile, review_instruction
from dualbrain.grounding.instruction.stop_commands import is_stop_command
from dualbrain.planner.introspection import planner_languages
from dualbrain.planner.protocol import STOP, Planner
from dualbrain.records import Proposal
from dualbrain.runtime.planner_request import PlanningContext

InstructionCheck = Literal["all", "before_planning", "given_contract"]
"""Which checks an instruction passes.

all: the review before planning, and the comparison of the contract with the words. before_planning: the review alone,
for planners whose answers do not depend on the words and that measure the gate and the filter. given_contract: a person
chose the contract and the words are a label; stop commands and hostile words still count.
"""
LOCAL_PLANNER = "local instruction check"
"""The author recorded for the contracts of the local layer."""
STOPPED = "stopped: the robot is at rest"
"""The reason of the outcome of a stop command."""


def answer_locally(
    instruction: str, context: PlanningContext, planner: Planner, check: InstructionCheck = "all"
) -> StopCommand | Refusal | None:
    """The answer of the local layer to `instruction`; None if `planner` is to be asked."""
    if check == "given_contract":
        return StopCommand() if is_stop_command(instruction) else refuse_hostile(instruction)
    languages = planner_languages(planner)
    return review_instruction(
        instruction, context.registry, context.scene.receptive, context.scene.graspable, languages=languages
    )


def local_proposal(answer: StopCommand | Refusal, registry: SkillRegistry, contract_id: str) -> Proposal:
    """The proposal of the local layer: a contract that stops the robot or declines the instruction."""
    action = stop_action(registry) if isinstance(answer, StopCommand) else _decline(answer)
    contract = Contract(contract_id, Context(registry.robot, registry.hash), (action,))
    return Proposal(
        text=canonical_contract(contract, registry),
        finish_reason=STOP,
        planner=LOCAL_PLANNER,
        constrained_by="nothing (local layer)",
        timings={"total": 0.0},
    )


def stop_action(registry: SkillRegistry) -> Action:
    """The action that brings the robot to rest: `stop`, or for an arm the shortest `hold`."""
    skill = registry.skill("stop" if "stop" in registry.by_name else "hold")
    numbers = (one for one in skill.parameters if isinstance(one, NumberParameter))
    return Action(skill.name, {one.name: one.lower for one in numbers})


def _decline(refusal: Refusal) -> Action:
    return Action("decline", {"reason": refusal.brief_reason})


def reject_mismatch(
    proposal: Proposal, instruction: str, context: PlanningContext, check: InstructionCheck = "all"
) -> Rejected | None:
    """The rejection of a contract about something that `instruction` does not mention.

    None for a text that is no contract, which the gate rejects, and for an instruction in another language than
    English, whose words are not compared.
    """
    data = proposal.text.encode("utf-8", "surrogatepass")
    if check != "all" or len(data) > MAX_BYTES or detect_foreign_language(instruction) is not None:
        return None
    try:
        contract = msgspec.json.decode(data, type=Contract)
    except DECODE_ERRORS:
        return None
    scene = context.scene
    return find_mismatch(contract, instruction, SceneVocabulary(scene.graspable, scene.receptive, context.holding))
