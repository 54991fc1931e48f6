"""Answers from memory: a remembered contract that carries out the instruction is reused without asking the planner.

A memory is confident if its contract succeeded near this situation several times without much intervention: the weight
w̄ of a contract near a situation (paper 5.2) starts at 0.5, rises with every clean success and falls with every other
outcome. Whether its contract carries out the present instruction is not decided by similarity: the goal is read from
the words (`read_goal`) and compared with the effects of the contract, as for every answer of a planner. The gate and
the filter check a reused contract as any other.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import msgspec

from dualbrain.contracts.canonical_form import canonical_contract
from dualbrain.contracts.contract import NAMING_PARAMETERS, Action, Context, Contract
from dualbrain.errors import DECODE_ERRORS
from dualbrain.grounding.grasp_fit import is_level, least_opening
from dualbrain.grounding.instruction.goals.goal import Goal, Placed, Unread
from dualbrain.grounding.instruction.goals.goal_coverage import IDLE_SKILLS, find_uncovered
from dualbrain.grounding.instruction.goals.goal_reading import read_goal
from dualbrain.grounding.parameter_values import fitted_opening
from dualbrain.planner.protocol import STOP
from dualbrain.records import Episode, Exemplar, Proposal, RetrievedContext, Scene
from dualbrain.runtime.planning.planner_request import PlanningContext

REUSED_CONTRACT = "reused contract"
"""The author recorded for a contract from memory: one source, so that the limits of trust hold for all of them."""
MIN_WEIGHT = 0.8
"""Least weight w̄ of a memory whose contract is reused: three clean successes of one contract in one scene give 0.9."""
MIN_SIMILARITY = 0.95
"""Least similarity s = (1 + cos)/2 of the situation in which the contract succeeded."""


def find_reusable(
    instruction: str, context: PlanningContext, recall: RetrievedContext, contract_id: str
) -> tuple[Exemplar, Proposal] | None:
    """The best confident memory, and its contract as a proposal for `instruction`; None if the planner is to be asked.

    None too for an instruction whose goal is not read, and with an object in the hand.
    """
    start = time.perf_counter()
    goal = read_goal(instruction, context.scene)
    if isinstance(goal, Unread) or context.holding is not None:
        return None
    registry = context.registry
    for exemplar in filter(is_confident, recall.exemplars):
        for actions in _candidates(exemplar.contract, goal):
            fitted = _fit_grasps(actions, context.scene)
            if fitted is None:
                continue
            contract = Contract(contract_id, Context(registry.robot, registry.hash), fitted)
            if find_uncovered(contract, goal, context.scene) is None:
                text = canonical_contract(contract, registry)
                timings = {"total": time.perf_counter() - start}
                return exemplar, Proposal(text=text, finish_reason=STOP, planner=REUSED_CONTRACT, timings=timings)
    return None


def is_confident(exemplar: Exemplar) -> bool:
    """Whether the contract of `exemplar` succeeded often enough, in situations near enough, to be reused."""
    return exemplar.succeeded and exemplar.weight >= MIN_WEIGHT and exemplar.similarity >= MIN_SIMILARITY


def _candidates(remembered: dict[str, Any], goal: Goal) -> Iterator[tuple[Action, ...]]:
    """The actions of the contract `remembered`: as they are, and with the names of a goal of one placement."""
    try:
        actions = msgspec.convert(remembered, Contract).action_sequence
    except DECODE_ERRORS:
        return
    if all(action.skill in IDLE_SKILLS for action in actions):
        return
    yield actions
    names = {str(action.params[key]) for action in actions for key in NAMING_PARAMETERS if key in action.params}
    match actions[:2], goal.conditions:
        case (
            (Action("grasp", grasp), Action("place", place)),
            (Placed((new_object,), "in" | "at", (new_destination,)), *_),
        ) if len(names) == 2:
            renamed = {str(grasp["object"]): new_object, str(place["destination"]): new_destination}
            yield tuple(_rename(action, renamed) for action in actions)
        case _:
            pass


def _rename(action: Action, names: dict[str, str]) -> Action:
    return Action(
        action.skill,
        {
            key: names.get(str(value), value) if key in NAMING_PARAMETERS else value
            for key, value in action.params.items()
        },
    )


def _fit_grasps(actions: tuple[Action, ...], scene: Scene) -> tuple[Action, ...] | None:
    """`actions` with openings that fit the objects of `scene`; None with an absent name or an axis that points up."""
    known = {*scene.graspable, *scene.receptive}
    if any(action.params[key] not in known for action in actions for key in NAMING_PARAMETERS if key in action.params):
        return None
    fitted = [_fit_grasp(action, scene) if action.skill == "grasp" else action for action in actions]
    return None if None in fitted else tuple(action for action in fitted if action is not None)


def _fit_grasp(grasp: Action, scene: Scene) -> Action | None:
    """`grasp` with an opening that fits its object; None if its finger axis points up."""
    obj, axis = scene.find(str(grasp.params["object"])), str(grasp.params["finger_axis"])
    if not is_level(obj, axis):
        return None
    if float(grasp.params["opening"]) >= least_opening(obj, axis):
        return grasp
    return Action("grasp", {**grasp.params, "opening": fitted_opening(obj, axis)})


def is_reused(episode: Episode) -> bool:
    """Whether the last proposal of `episode` was the contract of a memory."""
    return bool(episode.attempts) and episode.attempts[-1].proposal.planner == REUSED_CONTRACT
