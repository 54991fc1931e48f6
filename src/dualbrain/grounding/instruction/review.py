"""Review of an instruction before a planner is asked: a stop command, a refusal, or neither."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.skill_spec import NameParameter
from dualbrain.grounding.instruction.clauses.clause_classifier import (
    ClauseClassifier,
    ClauseEstimate,
    reads_all_skills,
)
from dualbrain.grounding.instruction.clauses.clause_search import Clause, find_clauses
from dualbrain.grounding.instruction.clauses.expressible import ALL_CAPABILITIES, capabilities
from dualbrain.grounding.instruction.clauses.rules.clause_rule import ClauseKind
from dualbrain.grounding.instruction.hostile import find_hostile_request
from dualbrain.grounding.instruction.language import ENGLISH, detect_foreign_language, is_understood
from dualbrain.grounding.instruction.stop_commands import is_stop_command
from dualbrain.grounding.instruction.words import has_hidden_division, normalise, without_hidden_characters

ADVICE: dict[ClauseKind, str] = {
    "condition": "give the instruction when the condition holds, without it",
    "loop": "ask for one repetition at a time",
    "time": "give the instruction when it is time",
    "count": "name each object, or ask for all objects of one kind",
    "exclusion": "name only what is meant",
    "relative place": "name a container or a place",
    "orientation": "leave the orientation out",
    "motion": "ask for the result alone",
    "handing over": "ask for the object to be picked up and held, or to be put at a place within your reach",
    "alternative": "choose one",
    "comparison": "name the object by its color and kind",
}
"""What a person can say instead, by the kind of the clause."""
MAX_INSTRUCTION = 1000
"""Longest instruction that is read [characters]."""
CLASSIFIER_MARGIN = 1.0
"""The classifier overrides the rules if the logarithm of its odds is beyond this value."""
KINDS_OF_THE_SCENE: frozenset[ClauseKind] = frozenset({"count", "exclusion", "relative place"})
"""Kinds of clauses that depend on the objects and places of the scene, which the classifier does not know."""
MAX_REASON = 120
"""Longest reason of a decline in a contract [characters]."""


@dataclass(frozen=True, slots=True)
class StopCommand:
    """The instruction is a stop command."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Refusal:
    """The instruction is declined: `reason` in one or two sentences, `quote` the words that it is about."""

    kind: Literal["length", "language", "hidden", "hostile", "clause", "absent", "grasp", "hand", "number"]
    reason: str
    quote: str
    brief: str

    @property
    def brief_reason(self) -> str:
        """The reason in at most `MAX_REASON` characters, for a contract that declines."""
        return self.brief if len(self.brief) <= MAX_REASON else f"{self.brief[: MAX_REASON - 1]}\u2026"


def review_instruction(
    instruction: str,
    registry: SkillRegistry,
    receptive: Sequence[str] = (),
    graspable: Sequence[str] = (),
    *,
    languages: Collection[str] = (ENGLISH,),
    classifier: ClauseClassifier | None = None,
) -> StopCommand | Refusal | None:
    """The answer of the local layer to `instruction`; None if a planner may be asked.

    `receptive` are the containers and places of the scene, `graspable` its objects, `languages` those that the planner
    declares. The rules read English: of an instruction in another declared language only stop commands are recognised.
    A `classifier` that is sure of a clause adds it to those of the rules, and one that is sure that there is none
    removes those that depend neither on the scene nor on the robot. It is asked only if the planner reads English alone
    and if it knows all skills of the robot.
    """
    if too_long := _refuse_length(instruction):
        return too_long
    if is_stop_command(instruction):
        return StopCommand()
    if has_hidden_division(instruction):
        return _refuse_hidden()
    foreign = detect_foreign_language(instruction)
    if foreign is not None:
        return None if is_understood(foreign, languages) else _refuse_language(foreign.name)
    asked = classifier if set(languages) == {ENGLISH} and reads_all_skills(registry) else None
    return refuse_hostile(instruction) or _refuse_clauses(instruction, registry, receptive, graspable, asked)


def refuse_hostile(instruction: str) -> Refusal | None:
    """The refusal of a hostile instruction, and of one that is too long to be read; None for all others."""
    if too_long := _refuse_length(instruction):
        return too_long
    request = find_hostile_request(normalise(instruction))
    if request is None:
        return None
    reason = f'The instruction is declined because of "{request.quote}": {request.reason}.'
    return Refusal(kind="hostile", reason=reason, quote=request.quote, brief=request.reason)


def _refuse_length(instruction: str) -> Refusal | None:
    if len(instruction) <= MAX_INSTRUCTION:
        return None
    brief = f"an instruction has at most {MAX_INSTRUCTION} characters"
    reason = f"The instruction has {len(instruction)} characters; at most {MAX_INSTRUCTION} are read. Shorten it."
    return Refusal(kind="length", reason=reason, quote="", brief=brief)


def _refuse_hidden() -> Refusal:
    brief = "the instruction has invisible characters inside a word"
    reason = "The instruction has invisible characters inside a word. Type it again instead of pasting it."
    return Refusal(kind="hidden", reason=reason, quote="", brief=brief)


def _refuse_language(name: str) -> Refusal:
    reason = f"The instruction seems to be in {name}, but this planner reads only English. Please say it in English."
    brief = f"this planner reads only English, and this seems to be {name}"
    return Refusal(kind="language", reason=reason, quote="", brief=brief)


def _refuse_clauses(
    instruction: str,
    registry: SkillRegistry,
    receptive: Sequence[str],
    graspable: Sequence[str],
    classifier: ClauseClassifier | None,
) -> Refusal | None:
    words = normalise(instruction)
    clauses = find_clauses(words, capabilities(registry), receptive, graspable)
    if classifier is not None:
        of_any_robot = find_clauses(words, ALL_CAPABILITIES, receptive, graspable)
        clauses = _weigh(clauses, of_any_robot, classifier.estimate(without_hidden_characters(instruction)))
    if not clauses:
        return None
    first = clauses[0]
    return Refusal(
        kind="clause", reason=_describe(clauses, registry, receptive), quote=first.quote, brief=brief_reason(first)
    )


def _weigh(
    clauses: tuple[Clause, ...], of_any_robot: tuple[Clause, ...], estimate: ClauseEstimate
) -> tuple[Clause, ...]:
    """The clauses that count; `of_any_robot` are those that no robot could express."""
    if estimate.score > CLASSIFIER_MARGIN and not clauses:
        return (Clause(estimate.kind, estimate.quote),)
    if estimate.score >= -CLASSIFIER_MARGIN:
        return clauses
    return tuple(one for one in clauses if one.by_scene or one.kind in KINDS_OF_THE_SCENE or one not in of_any_robot)


def brief_reason(clause: Clause) -> str:
    """The reason of a decline because of `clause`, as planners learn it."""
    quote = clause.quote if len(clause.quote) <= 60 else f"{clause.quote[:59]}\u2026"
    return f'no contract can express "{quote}" ({clause.kind})'


def _describe(clauses: Sequence[Clause], registry: SkillRegistry, receptive: Sequence[str]) -> str:
    quoted = " and ".join(f'"{clause.quote}" ({clause.kind})' for clause in clauses[:3])
    advice = "; ".join(dict.fromkeys(ADVICE[clause.kind] for clause in clauses[:3]))
    return (
        f"The instruction is declined as a whole, because a contract cannot express {quoted}. Instead, {advice}. "
        f"Skills: {_describe_skills(registry, receptive)}."
    )


def _describe_skills(registry: SkillRegistry, receptive: Sequence[str]) -> str:
    """The skills that can be asked for, and the destinations of those that place something or drive somewhere."""
    skills = ", ".join(skill.name for skill in registry.skills if skill.name != "decline")
    takes_places = any(
        isinstance(parameter, NameParameter) and parameter.of == "receptive"
        for skill in registry.skills
        for parameter in skill.parameters
    )
    places = ", ".join(name.replace("_", " ") for name in receptive)
    return f"{skills} (places: {places})" if takes_places and places else skills
