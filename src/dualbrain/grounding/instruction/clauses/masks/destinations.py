"""Sides of the scene as destinations: "on the left" means a place of the scene that has this side in its name."""

from __future__ import annotations

import re

from dualbrain.grounding.instruction.clauses.scene_words import PLACEHOLDER, SceneWords, fill, first_matches

SIDE = r"(?:left|right|front|back|middle|center)"
SIDE_PART = r"(?: hand)?(?: (?:side|part|half|end|area|section|hand side))?"
_DESTINATION = re.compile(
    rf"\b(?:over )?(?:to|on|onto|at|towards) (?:(?:the|your) )?(?P<side>{SIDE})(?P<part>{SIDE_PART})"
    r"\b(?! (?:of|edge|corner|hand|side|most|one|in front|behind|until|as far)\b)"
)
_SEGMENT_START = re.compile(r"[,.;:!?]| and | then ")
_NO_PLACING = re.compile(
    r"\b(?:pick|picks|lift|grab|grasp|hold|raise|seize|grip|turn|rotate|look|looks|face|faces|facing|point|points|lean"
    r"|tilt|(?<!of )reach|swing|fetch|get|veer|steer|bend|which|that is|that are|that lies|that stands|far|whatever)\b"
)
_AMOUNT = re.compile(
    r"\b(?:bit|little|touch|tad|slightly|somewhat|further|farther|more|as far|breadth|width|notch|inch|inches|steps?"
    r"|\d+(?:[.,]\d+)?|mm|cm|millimet\w+|centimet\w+|met(?:er|re)s?|by (?:an?|two|three|half))\b"
)
_DESCRIBES = re.compile(
    r"^ (?:in|into|inside|onto|goes|go|belongs?|should|must|has to|needs? to|can|could|shall|ought|comes?|may|will)\b"
)
"""The words after a side that describes an object, instead of being the destination."""


def mask_sides(text: str, scene: SceneWords) -> str:
    """`text` with the letter n in place of each side that is a destination and means one place of the scene.

    A side that describes an object ("the tin on the left goes in the bowl") and the length of a motion ("a bit to the
    left") are left as they are. "Push it to the left" means the place on the left; whether that is to the left of the
    object depends on the scene (`read_goal`).
    """
    for match in first_matches(_DESTINATION, text):
        if scene.has_side(match["side"]) and _is_destination(text, match):
            text = fill(text, match.start(), match.end(), PLACEHOLDER)
    return text


def _is_destination(text: str, match: re.Match[str]) -> bool:
    before = text[max(0, match.start() - 100) : match.start()]
    boundaries = [one.end() for one in _SEGMENT_START.finditer(before)]
    segment = before[boundaries[-1] if boundaries else 0 :]
    after = text[match.end() : match.end() + 30]
    following = re.split(r"[,.;:!?]| and | then ", after, maxsplit=1)[0]
    if _NO_PLACING.search(segment) or _AMOUNT.search(segment) or _AMOUNT.search(following):
        return False
    return _DESCRIBES.match(after) is None
