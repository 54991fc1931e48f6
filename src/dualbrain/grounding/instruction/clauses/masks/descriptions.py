"""Descriptions by position that only identify something: "the cube that is on the left".

A description is allowed where the noun phrase without it already identifies exactly one thing of the scene. With
several candidates the description would be dropped, so it remains a clause.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from dualbrain.grounding.instruction.clauses.masks.destinations import SIDE, SIDE_PART
from dualbrain.grounding.instruction.clauses.scene_words import SceneWords, fill, first_matches, noun_phrase_before

_END = (
    r"(?=$| (?:[.,;:!?]|in|into|inside|to|onto|on|at|and|then|should|must|has|have|needs?|goes|go|belongs?|is|are|with"
    r"|please|over|can|could|may|will|shall|ought|comes?|from|off|up)(?: |$))"
)
_THING = r"(?:the|a|an|that|this|those|these|my|your|our|its|two|the two|both) (?:\w+ ){0,3}?\w+"
_RELATION = (
    r"(?:(?:right |directly |just |immediately )?(?:behind|among|amongst|beneath|underneath|under"
    r"|below|next to|beside|besides|near"
    r"|in front of|close to|close by|adjacent to|opposite|by|alongside|to the left of|to the right of|on the left of"
    r"|on the right of|left of|right of|across from))"
)
_SIDE = (
    rf"(?:on|at|in|to) (?:the|your|my|our) (?:far |very |extreme |immediate )?(?:{SIDE}{SIDE_PART}|edge|corner)"
    r"(?: of the (?:table|room|scene|picture))?(?! of)|(?:on|at|to) (?:the )?n{4,}"
)
_HERE = (
    r"(?:straight |right |directly )?ahead(?: of (?:you|us|me))?"
    r"|(?:straight |right |directly )?(?:in front of|behind|next to|beside|near) (?:you|me|us|yourself)"
)
_POSITION = (
    rf"(?P<side>{_HERE}|{_SIDE})|(?P<relation>{_RELATION} (?:it|them|{_THING})"
    rf"|(?:in )?between (?:them|{_THING} and {_THING}|the (?:two )?(?:\w+ ){{0,2}}?\w+))"
)
_ADVERBS = (
    r"(?: (?:now|currently|presently|right now|over|just|still|standing|lying|sitting|placed|located|resting|there|here"
    r"|found|parked|positioned|kept|somewhere))"
)
_CLAUSE = re.compile(
    r"\b(?:(?P<relative>(?:that|which) (?:is|are|was|stands?|lies|sits|rests?|waits|you (?:can )?see|i see)"
    rf"{_ADVERBS}{{0,3}}) |(?P<participle>standing|hiding|hidden|lying|sitting|placed|located"
    rf"|resting|positioned|parked|waiting"
    rf"|over there|over here|there)(?P<adverbs>{_ADVERBS}{{0,2}}) )?(?:{_POSITION}){_END}"
)
_SOURCE = re.compile(r"\bfrom (?:the|your) (?:left|right|front|back)(?: hand)?(?: side)?(?! of)\b")
_THERE_IS = re.compile(r"\bthere (?:is|stands|lies|sits) (?:an?|one) (?P<noun>(?:\w+ ){0,2}?\w+) $")
_SEGMENT_START = re.compile(r"[,.;:!?]| and | then ")
_DESCRIBING_PLACE = re.compile(
    rf"\b(?:(?:(?:that|which) (?:is|are|stands?|lies?|sits?)|(?:standing|lying|sitting|placed)){_ADVERBS}{{0,2}} )?"
    r"(?:on|at) (?:the )?n{4,}(?= (?:in|into|inside|onto|goes|go|belongs?|should|must)\b)"
)
_PICK = re.compile(
    r"\b(?:pick|grasp|grab|grip|lift|seize|raise|touch|inspect|examine|find|hover|release|look at|looking at|show"
    r"|point (?:at|to))\b"
)
_TAKE = re.compile(r"\b(?:take|get|fetch|collect|choose|use|see|want|mean)\b")
_DRIVE = re.compile(r"\b(?:drive|go|head|return|come|roll|navigate|travel|proceed|stop|park|continue|visit|reach)\b")
_PUT_IT = re.compile(
    r"^ ?(?:,|;|\.|:|and|then)(?: (?:and|then|please))* "
    r"(?:put|place|drop|set|move|bring|lay|carry|stow|deposit|stand|take|transfer|grasp|grab|lift|hold|pick up"
    r"|push) (?:it|that|this)\b"
)
_INTO = re.compile(r"^ (?:please )?(?:in|into|inside|onto|to|over to)\b")
_INTO_LATER = re.compile(r"^ ?(?:[,:] )?(?:please )?(?:in|into|inside|onto|to|on|at|over to)\b")
_SUBJECT = re.compile(
    r"^(?: ,)? (?:should|must|has|needs?|can|could|shall|ought|goes|go|belongs?|is to|may|will|comes?)\b"
)


def mask_descriptions(text: str, scene: SceneWords) -> str:
    """`text` with the letter x in place of each description that identifies nothing further."""
    for match in first_matches(_CLAUSE, text):
        remark = _THERE_IS.search(text, max(0, match.start() - 60), match.start())
        phrase = f"the {remark['noun']}" if remark else noun_phrase_before(text, match.start())
        name = None if phrase is None else scene.identify(phrase)
        if name is not None and (remark or _is_description(text, match, name, scene)):
            text = fill(text, match.start(), match.end())
    for match in first_matches(_SOURCE, text):
        near = text[max(0, match.start() - 100) : match.end() + 100]
        mentions = scene.mentions(near, scene.graspable)
        if mentions and all(one.names == mentions[0].names and len(one.names) == 1 for one in mentions):
            text = fill(text, match.start(), match.end())
    return text


def ambiguous_descriptions(text: str, scene: SceneWords) -> Iterator[tuple[int, int]]:
    """Start and end of each position that describes one of several objects: "the block on the left side of the table".

    A place has a name and would otherwise be read as a destination. Without the objects of the scene there is
    none.
    """
    for match in (*first_matches(_DESCRIBING_PLACE, text), *first_matches(_CLAUSE, text)):
        if match.re is _CLAUSE and not match["relation"]:
            continue
        phrase = noun_phrase_before(text, match.start()) if scene.graspable else None
        if phrase and scene.mentions(phrase, scene.graspable) and scene.identify(phrase) is None:
            yield match.start(), match.end()


def _is_description(text: str, match: re.Match[str], name: str, scene: SceneWords) -> bool:
    """Whether the words of `match` describe the thing `name` in front of them, and are no destination of it."""
    if match["relative"]:
        return True
    before = text[max(0, match.start() - 100) : match.start()]
    boundaries = [one.end() for one in _SEGMENT_START.finditer(before)]
    segment = before[boundaries[-1] if boundaries else 0 :]
    after = text[match.end() : match.end() + 100]
    if name in scene.receptive:
        return bool(match["side"] or _DRIVE.search(segment))
    rest = re.split(r"[.;!?]", after, maxsplit=1)[0]
    if _PICK.search(segment) or (_TAKE.search(segment) and _PUT_IT.match(after)):
        return True
    into = _INTO_LATER if match["participle"] else _INTO
    return bool((into.match(after) or _SUBJECT.match(after)) and _has_target(rest, scene))


def _has_target(text: str, scene: SceneWords) -> bool:
    side = re.search(rf"\b(?:to|on|at) the ({SIDE})\b", text)
    return scene.has_destination(text) or (side is not None and scene.has_side(side[1]))
