"""Whether a contract, carried out as written, fulfils the goal of its instruction.

The goal comes from the words alone (`read_goal`), so the comparison shares nothing with the planner. It precedes the
gate: a contract that leaves a part of the instruction out is rejected before the robot moves, with a hint for the next
answer. An instruction that is not read (`Unread`) is not compared; its outcome is not judged either.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from dualbrain.contracts.contract import Contract
from dualbrain.contracts.schema import DECLINE, MAX_ACTIONS
from dualbrain.contracts.verdict import Rejected
from dualbrain.grounding.instruction.correspondence import INSTRUCTION_POINTER
from dualbrain.grounding.instruction.goals.action_bounds import actions_needed, is_there
from dualbrain.grounding.instruction.goals.goal import (
    Condition,
    Goal,
    Held,
    Observed,
    Placed,
    Pushed,
    RobotEnds,
    Step,
    Unread,
)
from dualbrain.grounding.instruction.goals.noun_phrases import Found, Vocabulary
from dualbrain.grounding.instruction.stated_values import PARAMETER_NAMES
from dualbrain.records import Scene

IDLE_SKILLS = frozenset({DECLINE, "hold", "stop"})
"""Skills that change nothing: a contract with these alone leaves nothing out that it claims to do."""
KNOWN_SKILLS = frozenset(
    ("grasp", "place", "release", "push", "move_to", "home", "drive_to", "drive_to_pose", "turn_to", *IDLE_SKILLS)
)
RESTING = (RobotEnds("still"), RobotEnds("rest"))
"""Conditions that a robot at rest fulfils."""
NAME_PARAMETERS = ("object", "destination", "target", "place")
"""Parameters with the name of an object or a place."""

_ABSENCE = re.compile(r"\bthere is no (?P<phrase>[a-z]+(?: [a-z]+){0,2}) here\b")
"""The reason of a decline that a thing is absent, in the words that the planners learn."""


@dataclass(frozen=True, slots=True)
class _Event:
    """One action: the kind of step that it carries out, its object ("" without one) and its destination."""

    kind: Literal["wait", "home", "drive", "grasp", "place", "push", "observe"]
    name: str = ""
    destination: str = ""


@dataclass(slots=True, kw_only=True)
class _Effects:
    """The effects of a contract that is carried out as written: objects and their destinations in the given order."""

    in_hand: str | None
    placed: dict[str, str] = field(default_factory=dict[str, str])
    pushed: dict[str, str] = field(default_factory=dict[str, str])
    observed: set[str] = field(default_factory=set[str])
    driven_to: str = ""
    visited: list[str] = field(default_factory=list[str])
    events: list[_Event] = field(default_factory=list["_Event"])

    @property
    def moved(self) -> frozenset[str]:
        """The objects that the contract moves on purpose."""
        return frozenset((*self.placed, *self.pushed, *([self.in_hand] if self.in_hand else ())))

    def put_down(self, destination: str) -> None:
        """The object in the hand is released at `destination` ("": where the hand is)."""
        if self.in_hand is not None:
            self.events.append(_Event("place", self.in_hand, destination))
            self.placed[self.in_hand], self.in_hand = destination, None

    def has(self, kind: str) -> bool:
        """Whether an action of this kind occurs."""
        return any(event.kind == kind for event in self.events)


def find_uncovered(
    contract: Contract, goal: Goal | Unread, scene: Scene, holding: str | None = None
) -> Rejected | None:
    """The rejection of a contract that does not fulfil `goal` if it is carried out in `scene`; None if it does.

    `holding` is the object in the hand at its beginning. None for an instruction that was not read, for contracts that
    decline or wait, and for those that the gate rejects because of their names or an empty hand.
    """
    if isinstance(goal, Unread) or all(action.skill in IDLE_SKILLS for action in contract.action_sequence):
        return None
    effects = _effects(contract, scene, holding)
    if effects is None:
        return None
    if reason := goal.decline or goal.beyond_contracts or _too_long(goal, scene, holding):
        return _rejected("a plan", ["decline"], f"the instruction is to be declined: {reason}")
    hints = [_missing(condition, goal, effects, scene) for condition in goal.conditions]
    for hint in (*hints, _missing_on_the_way(goal, effects), _other_number(contract, goal)):
        if hint:
            return _rejected("a plan without it", "a contract that carries out the whole instruction", hint)
    if others := sorted(effects.moved - goal.movable - {holding}):
        return _rejected(others[0], sorted(goal.movable), f"the instruction does not ask to move {_words(others[0])}")
    return _wrong_order(goal, effects)


def carries_out(contract: Contract, goal: Goal, scene: Scene) -> bool:
    """Whether `contract` fulfils `goal` by its own actions if it begins with an empty hand.

    `find_uncovered` only rejects. Here an object that is at its destination already, or may be, does not count, and a
    contract with an unknown skill or name, or that releases nothing, carries out no goal.
    """
    effects = _effects(contract, scene, None)
    if effects is None or not goal.conditions or find_uncovered(contract, goal, scene) is not None:
        return False
    is_idle = all(action.skill in IDLE_SKILLS for action in contract.action_sequence)
    placements = (condition for condition in goal.conditions if isinstance(condition, Placed))
    return not is_idle and all(_puts_down(condition, effects) for condition in placements)


def _puts_down(condition: Placed, effects: _Effects) -> bool:
    """Whether the contract puts down as many of the objects as `condition` asks for."""
    number = len(condition.objects) if condition.count is None else condition.count
    return sum(bool(effects.placed.get(name)) for name in condition.objects) == number


def find_unfounded_decline(
    contract: Contract, goal: Goal | Unread, scene: Scene, holding: str | None = None
) -> Rejected | None:
    """The rejection of a contract that only declines a `goal` that the words state and contracts can express.

    All names of such a goal are in `scene`, so a decline because of a missing object, place or skill is an error of the
    planner. A planner may have another reason, so it is asked again once and its second decline is accepted. A request
    to be at rest is fulfilled by a decline. Clauses that no contract can express are declined before the planner
    (`clauses/`), and their goals are not read again here.
    """
    if any(action.skill != DECLINE for action in contract.action_sequence):
        return None
    if isinstance(goal, Unread):
        return _reject_false_absence(contract, scene)
    if goal.decline or goal.beyond_contracts or _too_long(goal, scene, holding):
        return None
    effects = _Effects(in_hand=holding)
    wanted = [condition for condition in goal.conditions if condition not in RESTING]
    hints = [hint for condition in wanted if (hint := _missing(condition, goal, effects, scene))]
    if not hints:
        return None
    return _rejected("decline", "a contract that carries out the instruction", f"all its names are here: {hints[0]}")


def _reject_false_absence(contract: Contract, scene: Scene) -> Rejected | None:
    """The rejection of a decline whose reason states that a thing is absent, although it is in `scene`."""
    for action in contract.action_sequence:
        claim = _ABSENCE.search(str(action.params.get("reason", "")))
        found = Vocabulary(scene).resolve_reference(claim["phrase"]) if claim else None
        if claim and isinstance(found, Found):
            hint = f"the {claim['phrase']} is here: {found.names[0]}"
            return _rejected("decline", "a contract that carries out the instruction", hint)
    return None


def _effects(contract: Contract, scene: Scene, holding: str | None) -> _Effects | None:
    """The effects of `contract`; None if it has an unknown skill or name, or puts something down with an empty hand."""
    names, effects = {*scene.graspable, *scene.receptive}, _Effects(in_hand=holding)
    for action in contract.action_sequence:
        parameters = {key: str(value) for key, value in action.params.items()}
        named = {parameters[key] for key in NAME_PARAMETERS if key in parameters}
        is_empty = action.skill in ("place", "release") and effects.in_hand is None
        if action.skill not in KNOWN_SKILLS or not named <= names or is_empty:
            return None
        _add_effect(effects, action.skill, parameters)
    return effects


def _add_effect(effects: _Effects, skill: str, parameters: Mapping[str, str]) -> None:
    match skill:
        case "grasp":
            effects.in_hand = parameters.get("object")
            effects.placed.pop(effects.in_hand or "", None)
            effects.events.append(_Event("grasp", effects.in_hand or ""))
        case "place" | "release":
            effects.put_down(parameters.get("destination", ""))
        case "push":
            pushed, destination = parameters.get("object", ""), parameters.get("destination", "")
            effects.pushed[pushed] = destination
            effects.events.append(_Event("push", pushed, destination))
        case "move_to":
            effects.observed.add(parameters.get("target", ""))
            effects.events.append(_Event("observe", parameters.get("target", "")))
        case "drive_to":
            effects.driven_to = parameters.get("place", "")
            effects.visited.append(effects.driven_to)
            effects.events.append(_Event("drive", destination=effects.driven_to))
        case "drive_to_pose":
            effects.driven_to = ""
        case "home":
            effects.events.append(_Event("home"))
        case "hold" | "stop":
            effects.events.append(_Event("wait"))
        case _:
            pass


def _missing(condition: Condition, goal: Goal, effects: _Effects, scene: Scene) -> str:
    """A hint about the part of `condition` that the contract does not fulfil; "" if it fulfils all of it."""
    hint = ""
    match condition:
        case Placed():
            hint = _not_placed(condition, effects, scene)
        case Held(objects) if effects.in_hand not in objects:
            hint = f"the instruction asks to hold {_words(objects[0])} at the end"
        case Pushed(objects, _, reference):
            left = [name for name in objects if effects.pushed.get(name) != reference]
            hint = f"the instruction asks to push {_words(left[0])} to {_words(reference)}" if left else ""
        case Observed(name) if name not in effects.observed:
            hint = f"the instruction asks to move the hand above {_words(name)}"
        case RobotEnds("home") if not effects.has("home"):
            hint = "the instruction asks the robot to go home"
        case RobotEnds("drive", place) if effects.driven_to != place:
            hint = f"the instruction asks the robot to drive to {_words(place)}"
        case RobotEnds("still") if len(goal.conditions) == 1:
            hint = "the instruction asks the robot not to move"
        case _:
            pass
    return hint


def _not_placed(condition: Placed, effects: _Effects, scene: Scene) -> str:
    done = [name for name in condition.objects if _is_placed(name, condition, effects, scene)]
    number = len(condition.objects) if condition.count is None else condition.count
    if len(done) == number:
        return ""
    where = f"{_words(condition.relation)} {' and '.join(map(_words, condition.references))}"
    if len(done) > number:
        return f"the instruction asks for {number} {where}, and no other"
    left = [name for name in condition.objects if name not in done]
    return f"the instruction asks for {' and '.join(map(_words, left[: number - len(done)]))} {where}"


def _is_placed(name: str, condition: Placed, effects: _Effects, scene: Scene) -> bool:
    """Whether the object `name` is in the relation after the contract: put there, or there already and not moved."""
    if effects.placed.get(name):
        return (effects.placed[name] in condition.references) == (condition.relation != "off")
    return name not in effects.moved and is_there(name, condition, scene)


def _missing_on_the_way(goal: Goal, effects: _Effects) -> str:
    """A hint about a place or a pause before the end of `goal` that the contract leaves out; "" if it has all."""
    if unvisited := _unvisited(goal.visits, effects.visited):
        return f"the instruction asks the robot to drive to {_words(unvisited)} before"
    if goal.is_home_on_the_way and not effects.has("home"):
        return "the instruction asks the robot to go home before"
    return "the instruction asks the robot to wait" if goal.pauses and not effects.has("wait") else ""


def _other_number(contract: Contract, goal: Goal) -> str:
    """A hint about a number of the instruction that the contract does not keep; "" if it keeps all of them.

    Every number of a parameter must be one that the words state for it, and each stated one must occur.
    """
    for parameter, names in PARAMETER_NAMES.items():
        stated = [one for one in goal.values if one.parameter == parameter]
        params = [action.params for action in contract.action_sequence] if stated else []
        numbers = [float(given[name]) for given in params for name in names if name in given]
        kept = all(any(one.admits(number) for one in stated) for number in numbers)
        missing = next((one for one in stated if not any(one.admits(number) for number in numbers)), None)
        if not kept or missing is not None:
            return f"the instruction states {missing or stated[0]}"
    return ""


def _unvisited(asked: Sequence[str], visited: Sequence[str]) -> str:
    """The first place of `asked` that `visited` lacks in this order; "" if it has all of them."""
    rest = iter(visited)
    return next((place for place in asked if place not in rest), "")


def _too_long(goal: Goal, scene: Scene, holding: str | None) -> str:
    """Why no contract can have all actions of `goal`; "" if one can."""
    number = actions_needed(goal, scene, holding)
    return "" if number <= MAX_ACTIONS else f"it needs {number} actions, and a contract has at most {MAX_ACTIONS}"


def _wrong_order(goal: Goal, effects: _Effects) -> Rejected | None:
    """The rejection of steps in another order than the words state.

    A step that no action carries out is not compared: its object may be at its destination already.
    """
    planned: list[Step] = [step for group in goal.steps for step in group if _positions(step, effects)]
    position = -1
    for group in goal.steps:
        end = position
        for step in group:
            needed = min(_number(step), len(_positions(step, effects)))
            later = _positions(step, effects, position)
            if len(later) < needed:
                return _rejected_order(planned, effects)
            end = max(end, later[needed - 1]) if needed else end
        position = end
    return None


def _rejected_order(stated: Sequence[Step], effects: _Effects) -> Rejected:
    """The rejection of the steps `stated` in their order in the contract."""
    done = sorted(stated, key=lambda step: _positions(step, effects)[0])
    wanted = list(map(_step_words, stated))
    return _rejected(list(map(_step_words, done)), wanted, f"the instruction states the order {', then '.join(wanted)}")


def _positions(step: Step, effects: _Effects, after: int = -1) -> list[int]:
    """The first position behind `after` at which each object of `step` has an event that carries it out."""
    first: dict[str, int] = {}
    for index, event in enumerate(effects.events):
        if index > after and _is_carried_out(step, event):
            first.setdefault(event.name, index)
    return sorted(first.values())


def _is_carried_out(step: Step, event: _Event) -> bool:
    """Whether `event` carries out `step` for one of its objects."""
    match step, event.kind:
        case Placed(objects, relation, references), "place":
            done = event.name in objects and (event.destination in references) == (relation != "off")
        case Held(objects), "grasp":
            done = event.name in objects
        case Pushed(objects, _, reference), "push":
            done = event.name in objects and event.destination == reference
        case Observed(name), "observe":
            done = event.name == name
        case RobotEnds(movement, place), kind:
            kinds = ("wait", "home") if movement == "rest" else (movement,)
            done = kind in kinds and event.destination == place
        case _:
            done = step == "wait" == event.kind
    return done


def _number(step: Step) -> int:
    """Number of objects of `step` that are moved; 1 for any other step."""
    match step:
        case Placed(objects, _, _, count):
            return len(objects) if count is None else count
        case Pushed(objects):
            return len(objects)
        case _:
            return 1


def _step_words(step: Step) -> str:
    match step:
        case Placed(objects):
            words = " and ".join(map(_words, objects))
        case Held(objects):
            words = f"pick up {_words(objects[0])}"
        case Pushed(objects):
            words = f"push {' and '.join(map(_words, objects))}"
        case Observed(name):
            words = f"look at {_words(name)}"
        case RobotEnds(movement, place):
            words = {"drive": f"drive to {_words(place)}", "home": "go home"}.get(movement, movement)
        case _:
            words = "wait"
    return words


def _rejected(got: str | list[str], allowed: str | Sequence[str], hint: str) -> Rejected:
    accepted = allowed if isinstance(allowed, str) else list(allowed)
    return Rejected(stage="envelope", pointer=INSTRUCTION_POINTER, got=got, allowed=accepted, hint=hint)


def _words(name: str) -> str:
    return name.replace("_", " ")
