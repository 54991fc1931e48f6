"""Clauses of an instruction that the contracts of a robot cannot express, found before a planner is asked.

The check is local and deterministic. It reads English and knows the wordings in `clause_patterns.py` and in `rules`; a
clause in other words is not found. An instruction with a clause is declined as a whole, because a robot that does the
rest would do something else than the instruction asks for.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, islice

from dualbrain.grounding.instruction.clauses import clause_patterns as patterns
from dualbrain.grounding.instruction.clauses.expressible import Capabilities
from dualbrain.grounding.instruction.clauses.masks.contrasts import mask_contrasts, mask_negated_descriptions
from dualbrain.grounding.instruction.clauses.masks.counted_objects import mask_counts
from dualbrain.grounding.instruction.clauses.masks.descriptions import ambiguous_descriptions, mask_descriptions
from dualbrain.grounding.instruction.clauses.masks.destinations import mask_sides
from dualbrain.grounding.instruction.clauses.masks.figures_of_speech import mask_figures
from dualbrain.grounding.instruction.clauses.masks.parameter_values import mask_parameter_values
from dualbrain.grounding.instruction.clauses.object_destinations import object_destinations
from dualbrain.grounding.instruction.clauses.recipients import recipients_by_name
from dualbrain.grounding.instruction.clauses.rules.all_rules import RULES
from dualbrain.grounding.instruction.clauses.rules.clause_rule import ClauseKind, ClauseRule
from dualbrain.grounding.instruction.clauses.scene_words import SceneWords
from dualbrain.grounding.instruction.names import category_words, mask_places, side_pattern
from dualbrain.grounding.instruction.words import NUMBER_WORDS, Words, sentences

_BOUNDARY = re.compile(r"[,.;:!?](?!\d)|$")
MAX_CLAUSE, MAX_FOUND = 200, 30
"""Longest quote of a clause [characters], and number of clauses after which the search ends."""
_LATER_ACTION = re.compile(
    r"\b(?:then|and|afterwards|before) (?:\w+ ){0,2}?(?:put|place|drop|move|go|drive|release|bring|push|set)\b"
    r"|[,;.] (?:put|place|drop|move|go|drive|release|bring|push|set)\b"
)
_COMPLEMENT = re.compile(
    r"(?: (?!(?:and|then|or|but|if|unless|when|while|please|before|after|until|so|because|with|without|in|into|on|to)"
    r"\b)"
    r"[^\s,.;:!?]+){0,5}"
)
"""The words that complete a clause, so that the quote is "to the left of the bowl"; it matches every text."""
_SMALL_NUMBERS = NUMBER_WORDS | {"a": 1, "an": 1, "few": 5, "several": 8, "some": 5, "couple": 2, "of": 2, "dozen": 12}
_SECONDS = re.compile(r"\b(\d{1,6}(?:[.,]\d{1,6})?|[a-z]{1,10}) (s|secs?|seconds?)$")


@dataclass(frozen=True, slots=True)
class Clause:
    """A clause that contracts cannot express: its `kind`, and its words as the person wrote them.

    `by_scene`: it was found with the names of the scene.
    """

    kind: ClauseKind
    quote: str
    by_scene: bool = False


@dataclass(frozen=True, slots=True)
class _Containers:
    """The words for `all` destinations of a scene, and for those that are no side of a table (`vessels`)."""

    all: frozenset[str]
    vessels: frozenset[str]

    @staticmethod
    def of(receptive: Sequence[str]) -> _Containers:
        """The words for the destinations `receptive`."""
        vessels = [name for name in receptive if side_pattern(name) is None]
        return _Containers(category_words(receptive), category_words(vessels))


def find_clauses(
    words: Words, abilities: Capabilities, receptive: Sequence[str] = (), graspable: Sequence[str] = ()
) -> tuple[Clause, ...]:
    """The clauses of an instruction that contracts with `abilities` cannot express, in the order of the text.

    `receptive` are the names of the containers and places of the scene: "left side of the table" is not a direction
    where a place has this name, and only containers may be free or full. For a robot without a hand,
    "the left" is the only place on the left. `graspable` are the names of the objects: they decide which descriptions
    and numbers add nothing. Without them every description and number is a clause.
    """
    text = mask_places(words.text, receptive, sides_alone="occupancy" not in abilities.names)
    text = mask_parameter_values(text, abilities)
    scene = SceneWords(graspable, receptive)
    text = mask_negated_descriptions(text, scene)
    places = list(ambiguous_descriptions(text, scene))
    for mask in (mask_descriptions, mask_sides, mask_counts, mask_contrasts, mask_figures):
        text = mask(text, scene)
    places += object_destinations(text, scene)
    located: tuple[tuple[ClauseKind, Iterable[tuple[int, int]]], ...] = (
        ("relative place", places),
        ("handing over", recipients_by_name(words, scene)),
    )
    by_scene: list[tuple[int, int, ClauseKind]] = [(a, b, kind) for kind, spans in located for a, b in spans]
    found = list(by_scene)
    containers = _Containers.of(receptive)
    for start, end in sentences(text):
        if len(found) > MAX_FOUND:
            break
        found += _find_in_sentence(text, start, end, abilities, scene)
    for match in patterns.QUESTION_THEN.finditer(text):
        if not ("occupancy" in abilities.names and _is_about_occupancy(match[0], text, containers)):
            found.append((match.start(), match.end(), "condition"))
    for match in patterns.RETRACTION.finditer(words.text):
        found.append((match.start(), match.end(), "exclusion"))
    found = [one for one in found if not any(_is_inside(other, one) for other in found)]
    found.sort(key=lambda clause: (clause[0], -clause[1]))
    clauses: list[Clause] = []
    last_end = -1
    for start, end, kind in found:
        if start >= last_end:
            quote = words.quote(start, end).rstrip(" ,.;:!?")
            clauses.append(Clause(kind, quote, by_scene=(start, end, kind) in by_scene))
            last_end = end
    return tuple(clauses)


def _is_inside(one: tuple[int, int, ClauseKind], other: tuple[int, int, ClauseKind]) -> bool:
    """Whether `one` is a clause of another kind within the words of `other`, which it then explains better.

    A comparison and a loop are explained by their own first words ("the taller of the two bottles").
    """
    if other[2] in ("comparison", "loop"):
        return False
    return other[0] < one[0] and one[1] <= other[1] and one[2] != other[2]


def _find_in_sentence(
    text: str, start: int, end: int, abilities: Capabilities, scene: SceneWords
) -> Iterator[tuple[int, int, ClauseKind]]:
    sentence = text[start:end]
    containers = _Containers.of(scene.receptive)
    searches = (
        _conditions(sentence, text, abilities, containers),
        _orders(sentence, scene),
        _untils(sentence, text, abilities),
        _negations(sentence, text, abilities),
        _alternatives(sentence),
        _by_rules(sentence, abilities),
    )
    for first, last, kind in chain.from_iterable(islice(search, MAX_FOUND) for search in searches):
        yield start + first, start + last, kind


def _clause_end(sentence: str, after: int) -> int:
    """The end of the clause around `after`: the next punctuation mark, or the end of the sentence."""
    found = _BOUNDARY.search(sentence, after, after + MAX_CLAUSE)
    return found.start() if found else min(after + MAX_CLAUSE, len(sentence))


def _conditions(
    sentence: str, text: str, abilities: Capabilities, containers: _Containers
) -> Iterator[tuple[int, int, ClauseKind]]:
    occupancy = "occupancy" in abilities.names and patterns.OCCUPANCY.search(text) is not None
    excluded = [match.span() for match in patterns.NOT_A_CONDITION.finditer(sentence)]
    for match in patterns.CONDITION_WORD.finditer(sentence):
        if any(first <= match.start() < last for first, last in excluded):
            continue
        end = _clause_end(sentence, match.end())
        clause = sentence[match.start() : end].strip()
        if patterns.POLITE_CONDITION.match(clause):
            continue
        if occupancy and _is_about_occupancy(clause, text, containers):
            continue
        if _is_end_of_own_action(clause):
            continue
        yield match.start(), end, "condition"


def _is_about_occupancy(clause: str, text: str, containers: _Containers) -> bool:
    """Whether a container is free or full, which the scene shows before the plan; no other subject counts.

    "It" is a container only if `text` mentions one, and a state that comes out later is not visible.
    """
    if patterns.ELLIPTIC_CONDITION.match(clause):
        return True
    if patterns.OCCUPANCY.search(clause) is None or patterns.OTHERS.search(clause) is not None:
        return False
    if patterns.LATER_STATE.search(clause):
        return False
    if not containers.all:
        return True
    if patterns.FILLED.search(clause) and containers.vessels.isdisjoint(text.split()):
        return False
    subjects = containers.all | {"it", "that", "there"}
    return any(word in subjects or word.startswith("nn") for word in clause.split())


def _is_end_of_own_action(clause: str) -> bool:
    if not clause.startswith(("when", "once", "as soon as", "only when")):
        return False
    return patterns.DONE.search(clause) is not None and patterns.OTHERS.search(clause) is None


def _orders(sentence: str, scene: SceneWords) -> Iterator[tuple[int, int, ClauseKind]]:
    for match in patterns.BEFORE_AFTER.finditer(sentence):
        end = _clause_end(sentence, match.end())
        clause = sentence[match.start() : end].strip()
        own = patterns.ROBOT_ACTION.search(clause) or patterns.DONE.search(clause)
        if alone := patterns.NAME_ALONE.search(clause):
            unknown = scene.graspable and alone["article"] and not scene.mentions(clause, scene.names)
            own = own or not unknown
        if clause.startswith("after that ") and scene.mentions(clause.removeprefix("after that "), scene.graspable):
            own = True
        foreign = patterns.OTHERS.search(clause) and not clause.startswith(("before they come", "before we start"))
        if foreign or not own:
            yield match.start(), end, "time"


def _untils(sentence: str, text: str, abilities: Capabilities) -> Iterator[tuple[int, int, ClauseKind]]:
    for match in patterns.UNTIL.finditer(sentence):
        end = _clause_end(sentence, match.end())
        clause = sentence[match.start() : end].strip()
        turning = "turn" in abilities.names and patterns.TURN_UNTIL.search(sentence)
        waits = patterns.NEXT_WORD.match(clause) and patterns.WAIT_FOR_WORD.search(sentence[: match.start()])
        follows = _LATER_ACTION.search(text[text.find(clause) + 6 :]) is not None
        ordered = patterns.ORDERED.search(sentence) and patterns.DONE.search(clause)
        if not (turning or (waits and not follows) or ordered):
            yield match.start(), end, "loop"


def _negations(sentence: str, text: str, abilities: Capabilities) -> Iterator[tuple[int, int, ClauseKind]]:
    allowed = [match.span() for match in patterns.BY_CONSTRUCTION.finditer(sentence)]
    allowed += [match.span() for match in patterns.POLITE_CONDITION.finditer(sentence)]
    for pattern, purpose in (
        (patterns.UNTOUCHED, patterns.LOOKING),
        (patterns.UNLIFTED, patterns.PUSHING),
        (patterns.KEPT, patterns.LIFTING),
    ):
        if purpose.search(pattern.sub(" ", text)):
            allowed += [match.span() for match in pattern.finditer(sentence)]
    if "wait" in abilities.names or not {"occupancy"} & abilities.names:
        allowed += [match.span() for match in patterns.STANDING.finditer(sentence) if match[0].count(" ") > 1]
    allowed += [match.span() for match in patterns.ORDERED.finditer(sentence) if patterns.DONE.search(sentence)]
    if patterns.OCCUPANCY.search(text):
        allowed += [match.span() for match in re.finditer(r"\bis not\b", sentence) if "if it is not" in sentence]
    for match in patterns.NOT.finditer(sentence):
        if not any(first <= match.start() < last for first, last in allowed):
            yield max(0, match.start() - 3), _clause_end(sentence, match.end()), "exclusion"
    for match in patterns.WITHOUT.finditer(sentence):
        rest = sentence[match.start() :]
        lifted = patterns.WITHOUT_LIFTING.match(rest) and patterns.PUSHING.search(sentence)
        touched = patterns.WITHOUT_TOUCHING.match(rest) and patterns.LOOKING.search(sentence)
        if not (patterns.ALLOWED_WITHOUT.match(rest) or lifted or touched):
            yield match.start(), _clause_end(sentence, match.end()), "exclusion"


def _alternatives(sentence: str) -> Iterator[tuple[int, int, ClauseKind]]:
    for match in patterns.EITHER.finditer(sentence):
        yield match.start(), _clause_end(sentence, match.end()), "alternative"
    if patterns.WHETHER.search(sentence):
        return
    for match in patterns.OR.finditer(sentence):
        if not patterns.ALLOWED_OR.match(sentence[match.start() :]):
            yield match.start(), _clause_end(sentence, match.end()), "alternative"


def _by_rules(sentence: str, abilities: Capabilities) -> Iterator[tuple[int, int, ClauseKind]]:
    for rule in RULES:
        for match in rule.pattern.finditer(sentence):
            if rule.unless is not None and rule.unless.search(sentence):
                break
            if not _can_express(rule, match[0], abilities):
                complement = _COMPLEMENT.match(sentence, match.end())
                yield match.start(), complement.end() if complement else match.end(), rule.kind


def _can_express(rule: ClauseRule, quote: str, abilities: Capabilities) -> bool:
    if rule.capability not in abilities.names:
        return False
    return rule.capability != "wait" or _seconds(quote) <= abilities.longest_wait


def _seconds(quote: str) -> float:
    """The time [s] at the end of `quote`; infinite if it is not a number of seconds."""
    match = _SECONDS.search(quote)
    if match is None:
        return float("inf")
    number = match[1].replace(",", ".")
    return float(number) if number[0].isdigit() else float(_SMALL_NUMBERS.get(number, float("inf")))
