"""Reuse of a remembered contract: a contract that carried out this instruction in this place, without the planner.

Evidence counts for one contract in one place only, because most of the variance of an outcome belongs to this pair. A
contract is reused if it has a clean success in the same place (`match_places`), is there more often clean than not, and
has no failure or disputed outcome there. Whether it carries out the present instruction is not decided by similarity:
the goal is read from the words (`read_goal`), is of one step, and is compared with the effects of the contract, and the
manner of the request must be served (`read_manner`). The gate and the filter check a reused contract as any other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import msgspec

from dualbrain.contracts.canonical_form import canonical_contract
from dualbrain.contracts.contract import NAMING_PARAMETERS, Action, Context, Contract
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.skill_spec import NameParameter
from dualbrain.errors import DECODE_ERRORS
from dualbrain.grounding.instruction.goals.goal import Goal, Held, Observed, Placed, Pushed, RobotEnds, Unread
from dualbrain.grounding.instruction.goals.goal_coverage import carries_out
from dualbrain.grounding.instruction.goals.goal_reading import read_goal
from dualbrain.grounding.instruction.goals.manner import read_manner
from dualbrain.grounding.vocabulary import scene_names
from dualbrain.planner.protocol import STOP
from dualbrain.records import REUSED_CONTRACT, Episode, Exemplar, Precedent, Proposal, Scene
from dualbrain.runtime.planning.planner_request import PlanningContext, Retriever
from dualbrain.runtime.planning.reuse.same_place import match_places, same_posture

MAX_PRECEDENTS = 50
"""Number of successes in similar scenes that are compared with the present place."""
MAX_OUTCOMES = 200
"""Number of outcomes of one contract, the newest ones, among which a failure in this place excludes it."""


def find_reusable(
    instruction: str, context: PlanningContext, memory: Retriever, contract_id: str
) -> tuple[Exemplar, Proposal] | None:
    """The best precedent in this place, and its contract as a proposal for `instruction`; None: ask the planner.

    None too for an instruction whose goal is not read or needs several steps, and with an object in the hand.
    """
    goal = read_goal(instruction, context.scene)
    if isinstance(goal, Unread) or context.holding is not None or not (skills := _expected_skills(goal)):
        return None
    registry, scene = context.registry, context.scene
    examined: list[tuple[Action, ...]] = []
    for precedent in sorted(_clean_successes(context, memory), key=lambda one: one.Delta or 0.0):
        actions = _in_this_place(precedent, context)
        if tuple(action.skill for action in actions) != skills or not _are_possible(actions, registry, scene):
            continue
        contract = Contract(contract_id, Context(registry.robot, registry.hash), actions)
        if not (carries_out(contract, goal, scene) and _serves(precedent, instruction, actions)) or actions in examined:
            continue
        if _is_supported(_outcomes(precedent, contract, memory), context):
            text = canonical_contract(contract, registry)
            proposal = Proposal(text=text, finish_reason=STOP, planner=REUSED_CONTRACT, timings={})
            return _exemplar(precedent), proposal
        examined.append(actions)
    return None


def _clean_successes(context: PlanningContext, memory: Retriever) -> list[Precedent]:
    """The clean successes in similar scenes."""
    robot, registry = context.robot_model.name, context.registry.hash
    found = memory.find_precedents(context.summary, context.posture, robot, registry, max_count=MAX_PRECEDENTS)
    return [one for one in found if one.evidence == "clean"]


def _outcomes(precedent: Precedent, contract: Contract, memory: Retriever) -> list[Precedent]:
    """All outcomes of a contract, under its remembered and under its present names."""
    robot, registry = contract.context.robot, contract.context.registry
    remembered, present = precedent.contract, msgspec.to_builtins(contract)
    spellings = [remembered] if _decode(remembered) == contract.action_sequence else [remembered, present]
    return [one for each in spellings for one in memory.find_outcomes(each, robot, registry, max_count=MAX_OUTCOMES)]


def is_reused(episode: Episode) -> bool:
    """Whether the last proposal of `episode` was the contract of a memory."""
    return bool(episode.attempts) and episode.attempts[-1].proposal.planner == REUSED_CONTRACT


def has_reused_contract(episode: Episode) -> bool:
    """Whether a proposal of `episode` was the contract of a memory, also if the gate rejected it."""
    return any(attempt.proposal.planner == REUSED_CONTRACT for attempt in episode.attempts)


def _expected_skills(goal: Goal) -> tuple[str, ...]:
    """The skills of a contract that carries out a `goal` of one step and nothing else; () for any other goal.

    The order of several steps, and the step to which a manner belongs, are not compared.
    """
    match goal.conditions:
        case (Placed((_,), "in" | "at", (_,)),):
            skills = ("grasp", "place")
        case (Held((_,), handed=False),):
            skills = ("grasp",)
        case (Pushed((_,)),):
            skills = ("push",)
        case (Observed(),):
            skills = ("move_to",)
        case (RobotEnds("home"),):
            skills = ("home",)
        case (RobotEnds("drive"),):
            skills = ("drive_to",)
        case _:
            skills = ()
    return skills


def _in_this_place(precedent: Precedent, context: PlanningContext) -> tuple[Action, ...]:
    """The actions of a precedent of this place, in the present names of objects and places; () if it is of another."""
    if not same_posture(precedent.q, context.posture.q):
        return ()
    names = match_places(precedent.scene, context.scene)
    return () if names is None else _renamed(_decode(precedent.contract), names)


def _is_supported(outcomes: Sequence[Precedent], context: PlanningContext) -> bool:
    """Whether the outcomes of one contract in this place are more often clean than unclean, and none is against it."""
    here = [one.evidence for one in outcomes if _in_this_place(one, context)]
    return "against" not in here and here.count("clean") > here.count("unclean")


def _exemplar(precedent: Precedent) -> Exemplar:
    """The precedent as the only memory that the contract follows."""
    return Exemplar(
        episode_id=precedent.episode_id,
        instruction=precedent.instruction,
        summary=precedent.summary,
        contract=precedent.contract,
        succeeded=True,
        Delta=precedent.Delta,
        similarity=1.0,
        weight=precedent.weight,
        score=1.0,
        rank=1,
    )


def _decode(remembered: dict[str, Any]) -> tuple[Action, ...]:
    """The actions of a remembered contract, none of a malformed one."""
    try:
        return msgspec.convert(remembered, Contract).action_sequence
    except DECODE_ERRORS:
        return ()


def _renamed(actions: tuple[Action, ...], names: Mapping[str, str]) -> tuple[Action, ...]:
    """The `actions` with other `names` of objects and places; () if one of them has no present name."""
    if not all(str(action.params[key]) in names for action in actions for key in _naming_keys(action)):
        return ()
    return tuple(
        Action(action.skill, action.params | {key: names[str(action.params[key])] for key in _naming_keys(action)})
        for action in actions
    )


def _naming_keys(action: Action) -> list[str]:
    return [key for key in NAMING_PARAMETERS if key in action.params]


def _are_possible(actions: tuple[Action, ...], registry: SkillRegistry, scene: Scene) -> bool:
    """Whether all skills are registered, have all their parameters, and name things of `scene`."""
    return all(_is_possible(action, registry, scene) for action in actions)


def _is_possible(action: Action, registry: SkillRegistry, scene: Scene) -> bool:
    skill, names = registry.by_name.get(action.skill), scene_names(scene)
    if skill is None or set(action.params) != {parameter.name for parameter in skill.parameters}:
        return False
    naming = (parameter for parameter in skill.parameters if isinstance(parameter, NameParameter))
    return all(action.params[one.name] in names.names_of_kind(one.of) for one in naming)


def _serves(precedent: Precedent, instruction: str, actions: tuple[Action, ...]) -> bool:
    """Whether the contract for the remembered instruction also has the manner of the present one."""
    names = {*_names(_decode(precedent.contract)), *_names(actions)}
    return read_manner(precedent.instruction, names).serves(read_manner(instruction, names))


def _names(actions: tuple[Action, ...]) -> Iterator[str]:
    """The names of objects and places in `actions`."""
    for action in actions:
        yield from (str(action.params[key]) for key in _naming_keys(action))
