"""Scores of an unconstrained answer: is it JSON, does the gate accept it, and does it do as instructed?"""

from __future__ import annotations

import json
from collections.abc import Callable

import msgspec

from dualbrain.contracts.contract import Action, Contract
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.skill_spec import NameParameter
from dualbrain.errors import DECODE_ERRORS

INSTRUCTED_NUMBERS = frozenset({("hold", "duration"), ("turn_to", "heading")})
"""Numbers that the instruction states; the planner chooses all others."""


class AnswerScore(msgspec.Struct, frozen=True):
    """Scores of one answer.

    `json`: it is valid JSON. `compliant`: the judge accepts it, and it declines exactly if the reference does.
    `skills`: the skills of the reference in its order. `named`: with the same names, and the numbers of the
    instruction.
    """

    json: bool
    compliant: bool
    skills: bool
    named: bool

    @property
    def is_right(self) -> bool:
        """Whether it is compliant with the right skills and names."""
        return self.compliant and self.skills and self.named


def score_answer(text: str, reference: str, registry: SkillRegistry, accepts: Callable[[bytes], bool]) -> AnswerScore:
    """The scores of `text` against the contract `reference`; `accepts` is the gate."""
    goal = msgspec.json.decode(reference, type=Contract).action_sequence
    try:
        json.loads(text)
    except (ValueError, RecursionError):
        return AnswerScore(json=False, compliant=False, skills=False, named=False)
    accepted = accepts(text.encode("utf-8", "surrogatepass"))
    try:
        actions = msgspec.json.decode(text, type=Contract).action_sequence
    except DECODE_ERRORS:
        return AnswerScore(json=True, compliant=False, skills=False, named=False)
    skills = [action.skill for action in actions] == [action.skill for action in goal]
    named = skills and all(
        _matches_instruction(action, reference, registry) for action, reference in zip(actions, goal, strict=True)
    )
    return AnswerScore(
        json=True, compliant=accepted and _declines(actions) == _declines(goal), skills=skills, named=named
    )


def _declines(actions: tuple[Action, ...]) -> bool:
    return any(action.skill == "decline" for action in actions)


def _matches_instruction(action: Action, reference: Action, registry: SkillRegistry) -> bool:
    """Whether all parameters that the instruction decides are equal in both actions."""
    decided = [p.name for p in registry.skill(reference.skill).parameters if isinstance(p, NameParameter)]
    decided += [name for skill, name in INSTRUCTED_NUMBERS if skill == reference.skill]
    return all(action.params.get(name) == reference.params.get(name) for name in decided)
