"""The number of actions of a contract that fulfils a goal, for a robot whose base does not move."""

from __future__ import annotations

from dualbrain.contracts.schema import MAX_ACTIONS
from dualbrain.grounding.instruction.goals.goal import Condition, Goal, Held, Observed, Placed, Pushed, RobotEnds
from dualbrain.grounding.outcome.spatial_relations import relation_holds
from dualbrain.records import Scene

ACTIONS_PER_OBJECT = 2
"""Actions that put one object somewhere: grasp and place."""


def action_bounds(goal: Goal, scene: Scene, holding: str | None = None) -> tuple[int, int] | None:
    """Least and largest number of actions for `goal` in `scene` with the object `holding` in the hand.

    An object that is at its destination already, or may be, need not be moved again. None for a goal that needs no
    action or more than a contract may have.
    """
    least = sum(_actions(condition, scene, certain=True) for condition in goal.conditions)
    most = sum(_actions(condition, scene, certain=False) for condition in goal.conditions)
    most += goal.pauses + goal.is_home_on_the_way
    if holding is not None:
        saved = 1 if holding in goal.movable else 0
        least, most = least - saved, most + 1
    return (max(1, least), most) if 0 < most <= MAX_ACTIONS else None


def actions_needed(goal: Goal, scene: Scene, holding: str | None = None) -> int:
    """Least number of actions for the placements of `goal`."""
    placements = [condition for condition in goal.conditions if isinstance(condition, Placed)]
    return sum(_actions(condition, scene, certain=True) for condition in placements) - (holding is not None)


def is_there(name: str, condition: Placed, scene: Scene) -> bool:
    """Whether an object is in the relation already; one for which perception cannot decide counts as there."""
    obj = next((one for one in scene.objects if one.name == name), None)
    return obj is not None and relation_holds(obj, condition.relation, condition.references, scene) is not False


def _actions(condition: Condition, scene: Scene, *, certain: bool) -> int:
    """Actions for one condition; `certain`: without those for objects that may be at their destination already."""
    match condition:
        case Placed(objects, _, _, count):
            left = [name for name in objects if not (certain and is_there(name, condition, scene))]
            return ACTIONS_PER_OBJECT * min(len(left), len(objects) if count is None else count)
        case Held() | Observed() | RobotEnds("home"):
            return 1
        case Pushed(objects):
            return len(objects)
        case RobotEnds("rest" | "still"):
            return 0 if certain else 1
        case _:
            return 0
