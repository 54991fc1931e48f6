"""Negations that exclude nothing, because the instruction states the intended object: "the carton, not the block"."""

from __future__ import annotations

import re

from dualbrain.grounding.instruction.clauses.scene_words import SceneWords, fill, first_matches
from dualbrain.grounding.instruction.names import COLORS, GENERIC, name_words

_NOUN = r"(?:the|that|this|my) (?:\w+ ){0,3}?\w+"
_NEXT = (
    r"(?=$| (?:[.,;:!?]|goes|go|belongs?|should|must|has|needs?|can|and|into|in|on|to|at|is|please|there|here)(?: |$))"
)
_CONTRAST = re.compile(
    r"(?:, |\bbut |\band )(?:but |and |please )?(?P<not>(?:rather )?not (?:(?:out |over |just "
    r"|lying |sitting )*(?P<here>here|there)\b"
    rf"|(?P<place>(?:(?:in|into|inside|on|onto|to|at) {_NOUN}|(?:(?:in|on|to|at) )?(?:the )?n{{4,}}))"
    rf"|(?P<noun>{_NOUN}))){_NEXT}"
)
_NOT_BUT = re.compile(
    rf"\b(?P<not>not {_NOUN} ?,? )(?:but(?: rather)?|rather|i (?:said|meant?|want|need)) (?P<stated>{_NOUN}){_NEXT}"
)
PRESENT_PLACE = (
    r"(?:instead of|rather than) (?:just |being left |being |left )?(?:lying|sitting|standing"
    r"|hanging|rolling|scattered)"
    r"(?: (?:out|over|around|about|here|there|on the (?:table|bench|desk)))+"
)
"""The place where a thing lies now: "in the bowl instead of lying around there" excludes nothing."""
_PRESENT_PLACE = re.compile(rf"\b{PRESENT_PLACE}\b")
_GROUP = re.compile(
    r"\b(?:all|every|everything|everyone|each|any|anything|anywhere|somewhere|whatever|whichever|ones|only|nothing|most"
    r"|some|both|rest|others?)\b"
)


_NEGATED = re.compile(
    rf"(?:\b|(?<=^))(?P<noun>(?:(?:the|that|this) |(?:^|(?<=[.,;:!?] )))(?:\w+ ){{0,2}}?\w+) "
    r"(?P<not>(?:that|which) (?:is|are) (?:not|neither) "
    rf"(?P<excluded>(?:an? |the )?\w+(?: (?:or|nor|and not) (?:an? |the )?\w+)?)){_NEXT}"
)
_ARTICLES = frozenset({"a", "an", "the", "or", "nor", "and", "not"})


def mask_negated_descriptions(text: str, scene: SceneWords) -> str:
    """`text` with the letter x in place of each negation that leaves one object: "the block that is not red"."""
    for match in first_matches(_NEGATED, text):
        if len(_remaining(match, scene)) == 1:
            text = fill(text, match.start("not"), match.end("not"))
    return text


def _remaining(match: re.Match[str], scene: SceneWords) -> set[str]:
    """The objects of the scene that the noun means, without those that the negation excludes; empty if unknown."""
    noun = match["noun"].rsplit(" ", 1)[-1]
    meant = scene.mentions(match["noun"], scene.graspable)
    left = set(scene.graspable) if noun in GENERIC else {name for one in meant for name in one.names}
    for word in match["excluded"].split():
        if word in _ARTICLES:
            continue
        excluded = {name for name in scene.graspable if word in COLORS and word in name_words(name)}
        excluded |= {name for one in scene.mentions(word, scene.graspable) for name in one.names}
        if not excluded:
            return set()
        left -= excluded
    return left


def mask_contrasts(text: str, scene: SceneWords) -> str:
    """`text` with the letter x in place of each "not" that only repeats which object or place is not meant.

    A "not" that takes something out of a group ("all blocks, but not the red one") remains.
    """
    for match in first_matches(_NOT_BUT, text):
        if scene.identify(match["stated"]) is not None:
            text = fill(text, match.start("not"), match.end("not"))
    for match in first_matches(_PRESENT_PLACE, text):
        if scene.has_destination(text[_sentence_start(text, match.start()) : match.start()]):
            text = fill(text, match.start(), match.end())
    for match in first_matches(_CONTRAST, text):
        sentence = text[_sentence_start(text, match.start()) : match.start()]
        if not _GROUP.search(sentence) and _is_contrast(sentence, match, scene):
            text = fill(text, match.start("not"), match.end("not"))
    return text


def _sentence_start(text: str, before: int) -> int:
    return max(text.rfind(mark, 0, before) for mark in ".;!?") + 1


def _is_contrast(stated: str, match: re.Match[str], scene: SceneWords) -> bool:
    """Whether `stated` names one thing of the same kind as the excluded one, which differs from it."""
    if match["here"]:
        return scene.has_destination(stated)
    if match["place"]:
        return scene.has_destination(stated)
    mentions = scene.mentions(stated, scene.graspable)
    excluded = scene.mentions(match["noun"], scene.graspable)
    if not mentions or not excluded or any(one.several for one in mentions):
        return False
    named = {name for one in mentions for name in one.names}
    if len(mentions) == 1 and all(len(one.names) == 1 for one in excluded):  # "the bottle, not the orange one"
        return len(named - {name for one in excluded for name in one.names}) == 1
    if any(len(one.names) != 1 for one in mentions):
        return False
    return all(named.isdisjoint(one.names) for one in excluded)
