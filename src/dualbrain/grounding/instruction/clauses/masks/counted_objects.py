"""Numbers of objects that a list of names expresses: "both tins" where the scene has exactly two tins."""

from __future__ import annotations

import re

from dualbrain.contracts.schema import MAX_ACTIONS
from dualbrain.grounding.instruction.clauses.scene_words import SceneWords, fill, first_matches
from dualbrain.grounding.instruction.words import NUMBER_WORDS

_COUNTED = re.compile(
    r"\b(?:both(?: of)?(?: (?:the|these|those|my|our))?(?: two)?"
    r"|(?:all (?:of )?)?(?:the|these|those|my|our) (?P<number>two|three|four)|all (?P<all>two|three|four)) "
    r"(?P<noun>(?:\w+ ){0,2}?\w+s)\b"
)
_HOLDING = re.compile(r"\b(?:hold|holding|keep|above|hover)\b")
"""What a hand does with one object at a time, and with no destination."""
_ACTIONS_PER_OBJECT = 2
"""A grasp and a placement."""


def mask_counts(text: str, scene: SceneWords) -> str:
    """`text` with the letter x in place of each number that is the number of such objects in the scene.

    A contract must be able to name each object with a destination. A hand holds one object at a time, so "lift both
    tins" remains a clause.
    """
    for match in first_matches(_COUNTED, text):
        number = NUMBER_WORDS[match["number"] or match["all"] or "two"]
        fits = number * _ACTIONS_PER_OBJECT <= MAX_ACTIONS
        if _HOLDING.search(text):
            continue
        if fits and _count(match["noun"], scene) == number and scene.has_destination(text):
            text = fill(text, match.start(), match.start("noun") - 1)
    return text


def _count(noun: str, scene: SceneWords) -> int:
    """The number of objects in the scene that a plural noun means; 0 if it means no objects."""
    mentions = scene.mentions(noun, scene.graspable)
    return len(mentions[0].names) if len(mentions) == 1 and mentions[0].several else 0
