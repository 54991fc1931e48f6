"""What a free answer is worth: is it JSON, would the gate accept it, does it do what was said, in the right order?"""

from __future__ import annotations

import json
from collections.abc import Callable

import msgspec

from dualbrain.contracts.contract import Action, Contract
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.skill_spec import NameParameter
from dualbrain.errors import DECODE_ERRORS

INSTRUCTED_NUMBERS = frozenset({("hold", "duration"), ("turn_to", "heading")})
"""Numbers that the instruction gives; all others are the planner's to choose."""


class AnswerScore(msgspec.Struct, frozen=True):
    """One answer. `compliant`: accepted by whoever judges, and declined exactly where the instruction is impossible.

    `skills`: the wanted skills in the wanted order. `named`: the right things and places in them, and numbers as said.
    """

    json: bool
    compliant: bool
    skills: bool
    named: bool

    @property
    def is_right(self) -> bool:
        """All of it."""
        return self.compliant and self.skills and self.named


def score_answer(text: str, reference: str, registry: SkillRegistry, accepts: Callable[[bytes], bool]) -> AnswerScore:
    """What `text` is worth where a contract like `wanted` was asked for; `accepts` is the gate."""
    goal = msgspec.json.decode(reference, type=Contract).action_sequence
    try:
        json.loads(text)
    except (ValueError, RecursionError):
        return AnswerScore(json=False, compliant=False, skills=False, named=False)
    accepted = accepts(text.encode("utf-8", "surrogatepass"))
    try:
        found = msgspec.json.decode(text, type=Contract).action_sequence
    except DECODE_ERRORS:
        return AnswerScore(json=True, compliant=False, skills=False, named=False)
    skills = [action.skill for action in found] == [action.skill for action in goal]
    named = skills and all(
        _matches_instruction(ours, theirs, registry) for ours, theirs in zip(found, goal, strict=True)
    )
    return AnswerScore(
        json=True, compliant=accepted and _declines(found) == _declines(goal), skills=skills, named=named
    )


def _declines(actions: tuple[Action, ...]) -> bool:
    return any(action.skill == "decline" for action in actions)


def _matches_instruction(ours: Action, theirs: Action, registry: SkillRegistry) -> bool:
    """Whether what the instruction decides is the same in both."""
    decided = [p.name for p in registry.skill(theirs.skill).parameters if isinstance(p, NameParameter)]
    decided += [name for skill, name in INSTRUCTED_NUMBERS if skill == theirs.skill]
    return all(ours.params.get(name) == theirs.params.get(name) for name in decided)
