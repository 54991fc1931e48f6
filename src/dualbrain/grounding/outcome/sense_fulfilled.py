"""Sense "the request was carried out": the perceived changes, compared with the goal of the instruction.

The goal comes from the words of the instruction alone (`grounding.instruction.goals`), not from the contract; so a plan
for another task does not pass, however well it was executed.
"""

from __future__ import annotations

from collections.abc import Mapping

from dualbrain.grounding.instruction.goals.goal import (
    Condition,
    Goal,
    Held,
    Observed,
    Placed,
    Pushed,
    RobotEnds,
    Unmoved,
    Unread,
)
from dualbrain.grounding.outcome.changes_in_words import describe_changes
from dualbrain.grounding.outcome.evidence import Evidence
from dualbrain.grounding.outcome.goal_conditions import condition_holds, others_unmoved
from dualbrain.records import SenseVerdict

NAME = "fulfilled"


def judge_fulfilled(goal: Goal | Unread, evidence: Evidence) -> SenseVerdict:
    """Whether the instruction was carried out; a correct decline counts as that, a wrong one does not."""
    if isinstance(goal, Unread):
        return SenseVerdict(NAME, "not judged", goal.reason)
    if goal.decline or evidence.declined:
        return _judge_decline(goal, evidence)
    holds = {condition: condition_holds(condition, evidence) for condition in goal.conditions}
    others = others_unmoved(goal, evidence)
    if reason := _contradiction(goal, evidence, holds, others):
        return SenseVerdict(NAME, "contradicted", reason)
    if reason := _undecided(evidence, holds, others):
        return SenseVerdict(NAME, "not judged", reason)
    return SenseVerdict(NAME, "confirmed", f"Perceived: {describe_changes(evidence)}.")


def _contradiction(
    goal: Goal, evidence: Evidence, holds: Mapping[Condition, bool | None], others: Mapping[str, bool | None]
) -> str:
    """Evidence against the goal, as a sentence; "" if there is none."""
    if missed := next((one for one, state in holds.items() if state is False), None):
        return f"{_expected(missed)}, but perceived: {describe_changes(evidence)}."
    if shifted := [_words(name) for name, state in others.items() if state is False]:
        changes = describe_changes(evidence)
        return f"{', '.join(shifted)} moved, which the instruction does not ask for: {changes}."
    if unordered := _wrong_order(goal, evidence):
        return unordered
    return f"{', '.join(sorted(evidence.broken))} was broken." if evidence.broken else ""


def _undecided(evidence: Evidence, holds: Mapping[Condition, bool | None], others: Mapping[str, bool | None]) -> str:
    """Undecided conditions, as a sentence; "" if there are none."""
    if unsure := next((one for one, state in holds.items() if state is None), None):
        return f"{_expected(unsure)}; the senses cannot decide it: {describe_changes(evidence)}."
    names = [_words(name) for name, state in others.items() if state is None]
    return f"Whether {', '.join(names)} moved is within the perception error." if names else ""


def _words(name: str) -> str:
    return name.replace("_", " ")


def _judge_decline(goal: Goal, evidence: Evidence) -> SenseVerdict:
    reason = goal.decline or goal.beyond_contracts
    if not evidence.declined:
        return SenseVerdict(NAME, "contradicted", f"The instruction was to be declined: {reason}.")
    if not reason:
        return SenseVerdict(NAME, "contradicted", "The instruction was declined, although a skill can carry it out.")
    return SenseVerdict(NAME, "confirmed", f"The instruction was declined, and rightly: {reason}.")


def _wrong_order(goal: Goal, evidence: Evidence) -> str:
    """A sentence if objects were gripped in another order than the instruction names them; "" otherwise.

    Only placements of single objects have an order; the order of the objects of one phrase is free.
    """
    ranks = {
        one.objects[0]: rank
        for rank, group in enumerate(goal.steps)
        for one in group
        if isinstance(one, Placed) and len(one.objects) == 1
    }
    order = [grip.object_name for grip in evidence.all_grips if grip.object_name in ranks]
    last = [name for index, name in enumerate(order) if name not in order[index + 1 :]]
    wanted = sorted(last, key=lambda name: ranks[name])
    if last == wanted:
        return ""
    return f"The objects were placed in the order {', '.join(last)}, but the instruction states {', '.join(wanted)}."


def _expected(condition: Condition) -> str:
    """The condition as the beginning of a sentence."""
    match condition:
        case Placed(objects, relation, references, count):
            number = "" if count is None else f"{count} of "
            where = " and ".join(map(_words, references))
            return f"The instruction asks for {number}{_list(objects)} {_words(relation)} {where}"
        case Held(objects, handed):
            return f"The instruction asks for {_list(objects)} {'with a person' if handed else 'in the hand'}"
        case Pushed(objects, direction, reference):
            return f"The instruction asks to push {_list(objects)} {_words(direction)} {_words(reference)}".rstrip()
        case Unmoved(objects):
            return f"The instruction asks to leave {_list(objects)} in place"
        case Observed(name, _):
            return f"The instruction asks for the empty hand above {_words(name)}"
        case RobotEnds(movement, place):
            return f"The instruction asks the robot to end {movement} {_words(place)}".rstrip()


def _list(names: tuple[str, ...]) -> str:
    return ", ".join(map(_words, names))
