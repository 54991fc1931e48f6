"""Reuse of a remembered contract: a contract that carried out this instruction in this place, without the planner.

Evidence counts for one contract in one place only, because most of the variance of an outcome belongs to this pair. A
memory is reused if its contract succeeded in the same place (`match_places`), did not fail in another memory of this
place, and has a weight w̄ (paper 5.2) of at least one clean success. Whether its contract carries out the present
instruction is not decided by similarity: the goal is read from the words (`read_goal`) and compared with the effects of
the contract, and the manner of the request must be served (`read_manner`). The gate and the filter check a reused
contract as any other.
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
from dualbrain.grounding.instruction.goals.goal import Unread
from dualbrain.grounding.instruction.goals.goal_coverage import carries_out
from dualbrain.grounding.instruction.goals.goal_reading import read_goal
from dualbrain.grounding.instruction.goals.manner import read_manner
from dualbrain.grounding.vocabulary import scene_names
from dualbrain.planner.protocol import STOP
from dualbrain.records import REUSED_CONTRACT, Episode, Exemplar, Precedent, Proposal, Scene
from dualbrain.runtime.planning.planner_request import PlanningContext
from dualbrain.runtime.planning.reuse.same_place import match_places, same_posture

MIN_WEIGHT = 0.55
"""Least weight w̄ of a contract that is reused: one clean success gives 0.575, one clean and one other less than 0.5."""
MAX_PRECEDENTS = 50
"""Number of successes, and of failures, that are compared with the present place."""


def find_reusable(
    instruction: str, context: PlanningContext, precedents: Sequence[Precedent], contract_id: str
) -> tuple[Exemplar, Proposal] | None:
    """The best memory of this place, and its contract as a proposal for `instruction`; None: ask the planner.

    None too for an instruction whose goal is not read, and with an object in the hand.
    """
    goal = read_goal(instruction, context.scene)
    if isinstance(goal, Unread) or context.holding is not None:
        return None
    registry, scene = context.registry, context.scene
    here = list(_in_this_place(precedents, context))
    failed = [actions for exemplar, actions in here if not exemplar.succeeded]
    for exemplar, actions in sorted(here, key=_worth, reverse=True):
        if not is_confident(exemplar) or actions in failed or not _are_possible(actions, registry, scene):
            continue
        contract = Contract(contract_id, Context(registry.robot, registry.hash), actions)
        if carries_out(contract, goal, scene) and _serves(exemplar, instruction, actions):
            text = canonical_contract(contract, registry)
            return exemplar, Proposal(text=text, finish_reason=STOP, planner=REUSED_CONTRACT, timings={})
    return None


def is_confident(exemplar: Exemplar) -> bool:
    """Whether the contract of `exemplar` succeeded, and its clean successes outweigh its other outcomes."""
    return exemplar.succeeded and exemplar.weight >= MIN_WEIGHT


def is_reused(episode: Episode) -> bool:
    """Whether the last proposal of `episode` was the contract of a memory."""
    return bool(episode.attempts) and episode.attempts[-1].proposal.planner == REUSED_CONTRACT


def has_reused_contract(episode: Episode) -> bool:
    """Whether a proposal of `episode` was the contract of a memory, also if the gate rejected it."""
    return any(attempt.proposal.planner == REUSED_CONTRACT for attempt in episode.attempts)


def _in_this_place(
    precedents: Sequence[Precedent], context: PlanningContext
) -> Iterator[tuple[Exemplar, tuple[Action, ...]]]:
    """The memories of this place, with the actions of their contracts in the present names of objects and places."""
    for precedent in precedents:
        if not same_posture(precedent.q, context.posture.q):
            continue
        names = match_places(precedent.scene, context.scene)
        if names is not None and (actions := _renamed(_decode(precedent.exemplar.contract), names)):
            yield precedent.exemplar, actions


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


def _worth(memory: tuple[Exemplar, tuple[Action, ...]]) -> tuple[float, float, int]:
    """Order among memories of one place: the larger weight, then the smaller Δ, then the rank."""
    exemplar, _ = memory
    return exemplar.weight, -(exemplar.Delta or 0.0), -exemplar.rank


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


def _serves(exemplar: Exemplar, instruction: str, actions: tuple[Action, ...]) -> bool:
    """Whether the contract for the remembered instruction also has the manner of the present one."""
    names = {*_names(_decode(exemplar.contract)), *_names(actions)}
    return read_manner(exemplar.instruction, names).serves(read_manner(instruction, names))


def _names(actions: tuple[Action, ...]) -> Iterator[str]:
    """The names of objects and places in `actions`."""
    for action in actions:
        yield from (str(action.params[key]) for key in _naming_keys(action))
