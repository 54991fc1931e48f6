"""Objects that an instruction uses as a destination: "put the box on the tin", "drop the cube in the glass".

A contract places things only in containers and at named places, so an object that the hand can take is no destination.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from dualbrain.grounding.instruction.clauses.scene_words import SceneWords, first_matches

_ONTO = re.compile(
    r"\b(?:on|onto|upon|in|into|inside|atop|by|beside|near|behind|under|against) (?:top of )?(?:the|that|this"
    r"|my|your|our"
    r"|an?) (?P<noun>(?:\w+ ){0,2}?\w+)"
    r"(?=$| (?:[,.;:!?]|please|and|then|so|but|now|carefully|gently|slowly|for|with|without|before|after)(?: |$))"
)
_PLACING = re.compile(
    r"\b(?:put|place|set|drop|lay|stand|leave|balance|rest|move|bring|shift|pop|stick|tuck|squeeze|wedge|deposit|carry"
    r"|lower|transfer|insert|stow|goes|go|belongs?|should be|must be|sits?)\b"
)
_BESIDE = ("by ", "beside ", "near ", "behind ", "under ", "against ")
_HAND = re.compile(r"\b(?:hands?|gripper|fingers?|arm)\b")
_SEGMENT_START = re.compile(r"[,.;:!?]| and | then ")


def object_destinations(text: str, scene: SceneWords) -> Iterator[tuple[int, int]]:
    """Start and end of each destination that is an object of the scene; none if its objects are not known."""
    for match in first_matches(_ONTO, text) if scene.graspable else ():
        before = text[max(0, match.start() - 100) : match.start()]
        starts = [one.end() for one in _SEGMENT_START.finditer(before)]
        segment = before[starts[-1] if starts else 0 :]
        if not _has_object(segment, scene) or _HAND.search(segment):
            continue
        verbless = match[0].startswith("onto")
        if (_PLACING.search(segment) or verbless) and _is_object(match, scene):
            yield match.start(), match.end()


def _has_object(segment: str, scene: SceneWords) -> bool:
    """Whether something is placed: an object of the scene, or a pronoun."""
    return bool(re.search(r"\b(?:it|them|that|this|one)\b", segment) or scene.mentions(segment, scene.graspable))


def _is_object(match: re.Match[str], scene: SceneWords) -> bool:
    """Whether the noun means objects of the scene and no container or place; no place is beside a container."""
    if match[0].startswith(_BESIDE):
        return bool(scene.mentions(match["noun"], scene.names))
    if scene.mentions(match["noun"], scene.receptive):
        return False
    return bool(scene.mentions(match["noun"], scene.graspable))
