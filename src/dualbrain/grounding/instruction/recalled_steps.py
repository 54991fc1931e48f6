"""Steps that only a recalled episode contains: they are removed from the prompt, and refused in a plan.

A planner that is shown a recalled contract tends to copy it whole. A step of it that this instruction does not ask for,
such as a final `home`, would then be executed although no person asked for it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

import msgspec

from dualbrain.contracts.verdict import Rejected
from dualbrain.grounding.instruction.goals.goal_reading import requests_home
from dualbrain.records import Exemplar, RetrievedContext


def _mentions(words: str) -> Callable[[str], bool]:
    expression = re.compile(rf"\b(?:{words})\b")
    return lambda instruction: expression.search(instruction.lower()) is not None


OPTIONAL_SKILLS: dict[str, Callable[[str], bool]] = {
    "home": requests_home,
    "hold": _mentions("hold|wait|pause|rest|stop|still|moment|stay|keep|halt|freeze|seconds?|until|break|stand"),
    "move_to": _mentions(
        "look|over|above|hover|point|show|check|find|found|move|go|approach|where|which|what about|want"
    ),
    "push": _mentions("push|shove|slide|nudge|closer|towards?|lift|bit more|press|hit|off|against|away"),
    "release": _mentions("release|drop|let go|open|put down|set down|place|put|give|hand|down"),
}
"""Skills that a plan needs only if the words of an instruction ask for them, and whether they may.

The words are broad: a step is withheld only if nothing in the instruction can mean it.
"""


def unrequested_skills(contract: Mapping[str, Any], instruction: str) -> tuple[str, ...]:
    """The optional skills in `contract` that no word of `instruction` asks for, each once, in their order."""
    skills = [str(action.get("skill")) for action in contract.get("action_sequence", ())]
    requested = {skill: asks(instruction) for skill, asks in OPTIONAL_SKILLS.items()}
    return tuple(dict.fromkeys(skill for skill in skills if not requested.get(skill, True)))


def fit_recall(recall: RetrievedContext, instruction: str) -> tuple[RetrievedContext, tuple[str, ...]]:
    """`recall` without the steps that `instruction` does not contain, and the skills of these steps.

    A recalled contract whose last steps are not requested is shortened. One with such a step before a requested step,
    or with no other step, is not shown: a part from its middle cannot be left out. Warnings, and contracts that only
    wait, are shown as they are.
    """
    shown, withheld = list[Exemplar](), dict[str, None]()
    for exemplar in recall.exemplars:
        extra = () if _only_waits(exemplar.contract) else unrequested_skills(exemplar.contract, instruction)
        withheld.update(dict.fromkeys(extra))
        if not extra:
            shown.append(exemplar)
        elif contract := _without_last(exemplar.contract, extra):
            shown.append(msgspec.structs.replace(exemplar, contract=contract))
    ranked = [msgspec.structs.replace(one, rank=rank) for rank, one in enumerate(shown, start=1)]
    return msgspec.structs.replace(recall, exemplars=tuple(ranked)), tuple(withheld)


def _only_waits(contract: Mapping[str, Any]) -> bool:
    return all(action.get("skill") == "hold" for action in contract.get("action_sequence", ()))


def _without_last(contract: Mapping[str, Any], extra: tuple[str, ...]) -> dict[str, Any] | None:
    """`contract` without its last steps as far as they are in `extra`; None if others remain, or nothing."""
    actions = list(contract.get("action_sequence", ()))
    while actions and actions[-1].get("skill") in extra:
        actions.pop()
    if not actions or any(action.get("skill") in extra for action in actions):
        return None
    return {**contract, "action_sequence": actions}


def reject_recalled_step(contract: Mapping[str, Any], withheld: tuple[str, ...], instruction: str) -> Rejected | None:
    """The rejection of a plan with a step that only a recalled episode contains; None for other plans."""
    actions: list[Mapping[str, Any]] = list(contract.get("action_sequence", ()))
    unrequested = unrequested_skills(contract, instruction)
    for index, action in enumerate(actions):
        skill = str(action.get("skill"))
        if skill in withheld and skill in unrequested and len(actions) > 1:
            return Rejected(
                stage="envelope",
                pointer=f"/action_sequence/{index}/skill",
                got=skill,
                allowed="steps that the instruction asks for",
                hint=f"the instruction does not ask for {skill}; it is a step of a recalled episode: leave it out",
            )
    return None
