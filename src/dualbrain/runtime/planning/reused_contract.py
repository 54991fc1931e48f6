"""Reuse of a remembered contract: a contract of memory that carries out the instruction, without asking the planner.

A memory is confident if its contract succeeded near this situation several times without much intervention: the weight
w̄ of a contract near a situation (paper 5.2) starts at 0.5, rises with every clean success and falls with every other
outcome. Whether its contract carries out the present instruction is not decided by similarity: the goal is read from
the words (`read_goal`) and compared with the effects of the contract, and the words that are no part of the goal
(amount, duration, manner) must be those of the remembered instruction. The gate and the filter check a reused contract
as any other.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec

from dualbrain.contracts.canonical_form import canonical_contract
from dualbrain.contracts.contract import NAMING_PARAMETERS, Action, Context, Contract
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.skill_spec import NameParameter
from dualbrain.errors import DECODE_ERRORS
from dualbrain.grounding.grasp_fit import is_level, least_opening
from dualbrain.grounding.instruction.goals.goal import Goal, Placed, Unread
from dualbrain.grounding.instruction.goals.goal_coverage import carries_out
from dualbrain.grounding.instruction.goals.goal_reading import read_goal
from dualbrain.grounding.instruction.words import normalise
from dualbrain.grounding.parameter_values import fitted_opening
from dualbrain.grounding.vocabulary import scene_names
from dualbrain.planner.protocol import STOP
from dualbrain.records import REUSED_CONTRACT, Episode, Exemplar, Proposal, RetrievedContext, Scene
from dualbrain.runtime.planning.planner_request import PlanningContext

MIN_WEIGHT = 0.8
"""Least weight w̄ of a memory whose contract is reused: three clean successes of one contract in one scene give 0.9."""
MIN_SIMILARITY = 0.95
"""Least similarity s = (1 + cos)/2 of the situation in which the contract succeeded."""
NEUTRAL_WORDS = frozenset(
    [
        "a",
        "an",
        "the",
        "this",
        "that",
        "it",
        "its",
        "is",
        "are",
        "be",
        "of",
        "in",
        "into",
        "inside",
        "on",
        "onto",
        "at",
        "to",
        "put",
        "place",
        "move",
        "bring",
        "set",
        "lay",
        "take",
        "please",
        "kindly",
        "can",
        "could",
        "would",
        "you",
        "now",
        "just",
        "robot",
        "side",
    ]
)
"""Words in which an instruction may differ from the remembered one, besides the names: none states an amount, a
duration or a manner."""


def find_reusable(
    instruction: str, context: PlanningContext, recall: RetrievedContext, contract_id: str
) -> tuple[Exemplar, Proposal] | None:
    """The best confident memory, and its contract as a proposal for `instruction`; None if the planner is to be asked.

    None too for an instruction whose goal is not read, and with an object in the hand.
    """
    goal = read_goal(instruction, context.scene)
    if isinstance(goal, Unread) or context.holding is not None:
        return None
    registry, scene = context.registry, context.scene
    for exemplar in filter(is_confident, recall.exemplars):
        remembered = _decode(exemplar.contract)
        for actions in _candidates(remembered, goal, registry, scene):
            contract = Contract(contract_id, Context(registry.robot, registry.hash), actions)
            names = {*_names(remembered), *_names(actions)}
            if carries_out(contract, goal, scene) and _same_words(instruction, exemplar.instruction, names):
                text = canonical_contract(contract, registry)
                return exemplar, Proposal(text=text, finish_reason=STOP, planner=REUSED_CONTRACT, timings={})
    return None


def is_confident(exemplar: Exemplar) -> bool:
    """Whether the contract of `exemplar` succeeded often enough, in situations near enough, to be reused."""
    return exemplar.succeeded and exemplar.weight >= MIN_WEIGHT and exemplar.similarity >= MIN_SIMILARITY


def is_reused(episode: Episode) -> bool:
    """Whether the last proposal of `episode` was the contract of a memory."""
    return bool(episode.attempts) and episode.attempts[-1].proposal.planner == REUSED_CONTRACT


def has_reused_contract(episode: Episode) -> bool:
    """Whether a proposal of `episode` was the contract of a memory, also if the gate rejected it."""
    return any(attempt.proposal.planner == REUSED_CONTRACT for attempt in episode.attempts)


def _decode(remembered: dict[str, Any]) -> tuple[Action, ...]:
    """The actions of a remembered contract, none of a malformed one."""
    try:
        return msgspec.convert(remembered, Contract).action_sequence
    except DECODE_ERRORS:
        return ()


def _candidates(
    remembered: tuple[Action, ...], goal: Goal, registry: SkillRegistry, scene: Scene
) -> Iterator[tuple[Action, ...]]:
    """The actions `remembered` if they are possible in `scene`, with openings that fit its objects.

    They are taken as they are, and with the names of a goal of one placement.
    """
    for candidate in (remembered, *_renamed(remembered, goal)):
        if all(_is_known(action, registry, scene) for action in candidate):
            fitted = tuple(_fit(action, scene) for action in candidate)
            if None not in fitted:
                yield tuple(action for action in fitted if action is not None)


def _renamed(actions: tuple[Action, ...], goal: Goal) -> Iterator[tuple[Action, ...]]:
    """The `actions` with the names of a `goal` of one placement, if they name one object and one destination."""
    names = set(_names(actions))
    match actions[:2], goal.conditions:
        case (
            (Action("grasp", {"object": old_object}), Action("place", {"destination": old_destination})),
            (Placed((new_object,), "in" | "at", (new_destination,)), *_),
        ) if names == {old_object, old_destination}:
            renaming = {str(old_object): new_object, str(old_destination): new_destination}
            yield tuple(
                Action(
                    action.skill,
                    action.params | {key: renaming[str(action.params[key])] for key in _naming_keys(action)},
                )
                for action in actions
            )
        case _:
            pass


def _names(actions: tuple[Action, ...]) -> Iterator[str]:
    """The names of objects and places in `actions`."""
    for action in actions:
        yield from (str(action.params[key]) for key in _naming_keys(action))


def _naming_keys(action: Action) -> list[str]:
    return [key for key in NAMING_PARAMETERS if key in action.params]


def _is_known(action: Action, registry: SkillRegistry, scene: Scene) -> bool:
    """Whether the skill is registered, has all its parameters, and its names are those of `scene`."""
    skill, names = registry.by_name.get(action.skill), scene_names(scene)
    if skill is None or set(action.params) != {parameter.name for parameter in skill.parameters}:
        return False
    naming = (parameter for parameter in skill.parameters if isinstance(parameter, NameParameter))
    return all(action.params[one.name] in names.names_of_kind(one.of) for one in naming)


def _fit(action: Action, scene: Scene) -> Action | None:
    """`action`; a grasp with an opening that fits its object, or None if its finger axis points up."""
    if action.skill != "grasp":
        return action
    obj, axis = scene.find(str(action.params["object"])), str(action.params["finger_axis"])
    if not is_level(obj, axis):
        return None
    if float(action.params["opening"]) >= least_opening(obj, axis):
        return action
    return Action(action.skill, action.params | {"opening": fitted_opening(obj, axis)})


def _same_words(instruction: str, remembered: str, names: set[str]) -> bool:
    """Whether two instructions differ in `names` and `NEUTRAL_WORDS` only."""
    of_names = {word for name in names for word in name.split("_")}
    here, there = (set(normalise(text).text.split()) for text in (instruction, remembered))
    return here ^ there <= NEUTRAL_WORDS | of_names
