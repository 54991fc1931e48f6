"""The names and skills that a contract for a goal may need, for the decoder of the planner.

A planner that can only generate what the instruction asks for makes fewer wrong contracts. The gate and the comparison
with the goal (`goal_coverage.py`) do not depend on it and check every answer, also that of a planner without a schema.
"""

from __future__ import annotations

from dataclasses import dataclass

from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.schema import DECLINE
from dualbrain.grounding.instruction.goals.action_bounds import action_bounds
from dualbrain.grounding.instruction.goals.goal import (
    Condition,
    Goal,
    Held,
    Observed,
    Placed,
    Pushed,
    RobotEnds,
    Unread,
)
from dualbrain.grounding.vocabulary import scene_names
from dualbrain.records import Scene

STANDING = frozenset({"hold", "stop"})
DRIVING = frozenset({"drive_to", "drive_to_pose", "turn_to"})


@dataclass(frozen=True, slots=True)
class GoalScope:
    """Names and skills of the contracts for an instruction, and the number of actions; None: without a limit."""

    names: SceneNames
    skills: frozenset[str] | None = None
    length: tuple[int, int] | None = None


def goal_scope(goal: Goal | Unread, scene: Scene, holding: str | None = None) -> GoalScope:
    """The scope of `goal` in `scene` with the object `holding` in the hand.

    All names and skills if the instruction was not read, and for a goal that no contract fulfils, whose decline may
    need any words.
    """
    everything = scene_names(scene)
    if isinstance(goal, Unread) or goal.decline or goal.beyond_contracts:
        return GoalScope(everything)
    skills, names = {DECLINE}, set(goal.movable)
    for condition in goal.conditions:
        more_skills, more_names = _needs(condition, everything)
        skills |= more_skills
        names |= more_names
    if goal.pauses:
        skills |= STANDING
    if goal.is_home_on_the_way:
        skills |= {"home"}
    if holding is not None and holding not in names:  # the hand has to be emptied first, anywhere
        skills |= {"place", "release"}
        names |= set(everything.receptive)
    if scene.region:  # a base brings the arm to the objects
        skills |= DRIVING
        names |= set(everything.receptive)
    return GoalScope(
        SceneNames(
            tuple(name for name in everything.graspable if name in names),
            tuple(name for name in everything.receptive if name in names),
            everything.version,
        ),
        frozenset(skills),
        None if scene.region else action_bounds(goal, scene, holding),
    )


def _needs(condition: Condition, everything: SceneNames) -> tuple[set[str], set[str]]:
    """Skills and names for one condition, besides the objects that move."""
    match condition:
        case Placed(_, "off", references):
            needs = {"grasp", "place"}, set(everything.receptive) - set(references)
        case Placed(_, _, references):
            needs = {"grasp", "place"}, set(references)
        case Held():
            needs = {"grasp"}, set[str]()
        case Pushed(_, _, reference):
            needs = {"push"}, {reference}
        case Observed(name):
            needs = {"move_to"}, {name}
        case RobotEnds("home"):
            needs = {"home"}, set[str]()
        case RobotEnds("still"):
            needs = set(STANDING), set[str]()
        case RobotEnds("rest"):
            needs = {"home", *STANDING}, set[str]()
        case RobotEnds("drive", place):
            needs = set(DRIVING), {place}
        case _:
            needs = set[str](), set[str]()
    return needs
