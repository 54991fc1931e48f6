"""Noun phrases of an instruction, resolved to objects and places by colour, category, number and quantifier."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from dualbrain.grounding.instruction.goals.goal_words import (
    COLOURS,
    DETERMINERS,
    GENERAL_CONTAINERS,
    GENERIC_NOUNS,
    NO_OBJECTS,
    NUMBERS,
    PERSONS,
    SYNONYMS,
)
from dualbrain.grounding.instruction.names import SIDES
from dualbrain.grounding.instruction.words import are_letters_exchanged, corrected_function_word, is_one_edit_away
from dualbrain.records import Scene, SceneObject

SIDE_PARTS = r"(?:[- ]hand)?(?: (?:side|half|end|part|edge|area))?"
"""Words between the side and the thing of a place: "left-hand side of the table"."""
QUANTIFIER = re.compile(r"(?:all|every(?: one)?|each(?: one)?|both)(?: of)?\b ?")
SIZES = frozenset({"little", "small", "tiny", "big", "large", "tall", "short"})
MIN_CORRECTED = 4
"""Least length of a word whose spelling is corrected [letters]."""
MAX_WORDS = 2
"""An object that is not in the scene is recognised by an adjective and a noun at most."""
_COLOUR = "|".join(sorted(COLOURS))
ALL_COLOURED = re.compile(rf"(?:everything|anything|whatever|all)(?: (?:that|which))?(?: is|'s| are)? ({_COLOUR})")
"""All objects of a colour, without a noun: "everything that is red"."""
NOT_COLOUR = re.compile(
    rf"(?P<head>.+?) (?:that|which)(?: is not|'s not| isn't) (?:the )?(?P<colour>{_COLOUR})(?: one)?"
)
LOCATIVE = re.compile(
    r" (?:(?:that is |standing |lying |sitting |right |over )*(?:there|here|on the table)|there is"
    r"|we have(?: here)?|you see)$"
)
"""The end of a noun phrase that states that the object is in the scene."""
EVERYTHING = ("everything", "all", "all of it", "all things", "all objects", "all items", "all the things")


@dataclass(frozen=True, slots=True)
class Found:
    """The objects or places that a phrase names; `count` of them, None: all."""

    names: tuple[str, ...]
    count: int | None = None


@dataclass(frozen=True, slots=True)
class Absent:
    """The phrase names an object that is not in the scene."""

    phrase: str


@dataclass(frozen=True, slots=True)
class Unclear:
    """The phrase cannot be resolved; `reason` is a sentence."""

    reason: str


Resolved = Found | Absent | Unclear


class Vocabulary:
    """The names in a scene by which an instruction may refer to objects and places."""

    def __init__(self, scene: Scene) -> None:
        """Collect the objects, containers and places of `scene`."""
        self.objects = tuple(obj for obj in scene.objects if obj.role == "object")
        self.containers = tuple(obj for obj in scene.objects if obj.role == "container")
        self.places = tuple(place.name for place in scene.places)
        self.drives = bool(scene.region)

    def join_names(self, text: str) -> str:
        """`text` with every name of several words replaced by the name with underscores."""
        for name in self.places:
            for pattern in self._side_patterns(name):
                text = re.sub(pattern, name, text)
        aliases = [(name.replace("_", " "), name) for name in self.places]
        aliases += [(obj.name.replace("_", " "), obj.name) for obj in (*self.objects, *self.containers)]
        for alias, name in sorted(aliases, key=lambda pair: -len(pair[0])):
            text = re.sub(rf"\b{re.escape(alias)}\b", name, text)
        return text

    def _side_patterns(self, place: str) -> tuple[str, ...]:
        """Expressions for a place with a side, such as "left side of the table" and "left table side".

        For the only place there also "the left side" and "to the front", and for a base, which has no other left, "the
        left".
        """
        side = next((word for word in SIDES if word in place.split("_")), None)
        if side is None:
            return ()
        thing = " ".join(word for word in place.split("_") if word != side)
        found = (
            rf"\b{side}{SIDE_PARTS} (?:of|on|at) (?:the |my |our |your )?{thing}\b",
            rf"\b{side}(?:[- ]hand)? {thing}(?: side)?\b",
            rf"\b{thing} (?:on|to) (?:the |your )?{side}(?:[- ]hand side)?\b(?! of\b)",
            rf"\b{thing}(?:'s| 's)? {side}(?: side)?\b",
        )
        if sum(side in other.split("_") for other in self.places) == 1:
            found += (rf"\b(?<=the ){side}(?:[- ]hand)? (?:side|half|end)\b(?! of\b)",)
            alone = rf"{side}\b(?=[,.!?]|$| (?:and|then|please|first|side|aisle)\b)"
            found += (rf"\b(?<=the ){alone}",) if self.drives else ()
            found += (rf"\b(?<=to the ){alone}",) if side == "front" else ()
        return found

    def place_on_side(self, side: str) -> str | None:
        """The only place that has `side` ("left", "front") in its name; None if there are several, or none."""
        found = [name for name in self.places if side in name.split("_")]
        return found[0] if len(found) == 1 else None

    def correct_spelling(self, text: str) -> str:
        """`text` with common misspellings of function words, and words one letter away from a name, corrected."""
        things = (*self.objects, *self.containers)
        known = frozenset(word for obj in things for word in (obj.category, obj.colour) if word)
        return re.sub(r"[a-z']+", lambda word: _corrected(word.group(), known), text)

    def relation_to(self, phrase: str) -> str:
        """The preposition before a `phrase` that is a destination alone: "at" a place, "in" a container; else ""."""
        found = self.resolve_reference(phrase)
        if not isinstance(found, Found):
            return ""
        if found.names[0] in self.places:
            return "at"
        return "in" if any(obj.name == found.names[0] for obj in self.containers) else ""

    def resolve_object(self, phrase: str) -> Resolved:
        """The graspable objects that `phrase` names, such as "the red cube", "all tins", "both blocks"."""
        return _resolve(phrase, self.objects, (), all_objects=self.objects)

    def resolve_reference(self, phrase: str) -> Resolved:
        """The one object, container or place that `phrase` names."""
        found = _resolve(phrase, (*self.containers, *self.objects), self.places, all_objects=self.objects)
        if isinstance(found, Found) and len(found.names) != 1:
            return Unclear(f'"{phrase}" names several objects')
        return found


def _resolve(
    phrase: str, objects: Sequence[SceneObject], places: Sequence[str], *, all_objects: Sequence[SceneObject]
) -> Resolved:
    phrase = phrase.strip(" ,")
    if phrase in EVERYTHING:
        return Found(tuple(obj.name for obj in all_objects)) if all_objects else Absent(phrase)
    if excepted := re.fullmatch(r"(.+?) (?:except(?: for)?|but not|other than) (.+)", phrase):
        return _without(*(_resolve(one, objects, places, all_objects=all_objects) for one in excepted.groups()))
    phrase = LOCATIVE.sub("", re.sub(r"^(the |that |this )only ", r"\1", phrase))
    if other := NOT_COLOUR.fullmatch(phrase):
        every = f"all {other['head'].removeprefix('the ').removeprefix('that ')}"
        excluded = _resolve_one(f"all {other['colour']} {other['head'].split()[-1]}", objects, places)
        whole = _resolve_one(every, objects, places)
        left = whole if isinstance(excluded, Absent) else _without(whole, excluded)
        return left if not isinstance(left, Found) or len(left.names) == 1 else Unclear(f'"{phrase}" may be several')
    if colored := ALL_COLOURED.fullmatch(phrase):
        phrase = f"all {colored[1]} things"
    phrase = re.sub(
        rf"^(the |that |this |a )?(.+?) (?:that|which)(?: is|'s) (?:the )?({_COLOUR})(?: one)?$", r"\1\3 \2", phrase
    )
    if " and " in phrase:
        phrase = phrase.removeprefix("both ")
    parts = [part for part in re.split(r",? and |, ", phrase) if part]
    noun = parts[-1].split()[-1] if parts else ""
    parts = [f"{part} {noun}" if re.sub(r"^the ", "", part) in COLOURS else part for part in parts]
    if len(parts) > 1:
        return _united([_resolve(part, objects, places, all_objects=all_objects) for part in parts])
    return _resolve_one(phrase, objects, places)


def _without(whole: Resolved, part: Resolved) -> Resolved:
    if isinstance(whole, Found) and isinstance(part, Found):
        return Found(tuple(name for name in whole.names if name not in part.names))
    return part if isinstance(whole, Found) else whole


def _united(parts: Sequence[Resolved]) -> Resolved:
    for part in parts:
        if not isinstance(part, Found):
            return part
    if any(isinstance(part, Found) and part.count is not None for part in parts):
        return Unclear("a number within a list is not read")
    return Found(tuple(dict.fromkeys(name for part in parts if isinstance(part, Found) for name in part.names)))


def _resolve_one(phrase: str, objects: Sequence[SceneObject], places: Sequence[str]) -> Resolved:
    every = QUANTIFIER.match(phrase)
    words = (phrase[every.end() :] if every else phrase).split()
    indefinite = bool(words) and words[0] in ("a", "an", "any")
    words = [word for word in words if word not in DETERMINERS]
    number = NUMBERS.get(words[0]) if len(words) > 1 else None
    words = words[1 + (words[1:2] == ["of"]) :] if number is not None else words
    if not words:
        return Unclear("a noun phrase is empty")
    if len(words) == 1 and words[0] in places:
        return Found((words[0],))
    named = tuple(obj.name for obj in objects if len(words) == 1 and obj.name == words[0])
    matches = named or tuple(obj.name for obj in objects if _matches(words, obj))
    if not matches and (plain := [word for word in words if word not in SIZES]) and plain != words:
        sized = tuple(obj.name for obj in objects if _matches(plain, obj))  # a size adds nothing to the only one
        return Found(sized) if len(sized) == 1 else Unclear(f'"{phrase}" compares sizes')
    if not matches:
        return _missing(words, objects)
    if number is not None:
        return Found(matches, number) if number <= len(matches) else Absent(phrase)
    plural = words[-1] not in {obj.category for obj in objects} and words[-1] != _singular(words[-1])
    plural = plural or words[-1] == "stuff"
    return _counted(phrase, matches, several=every is not None or plural, indefinite=indefinite)


def _counted(phrase: str, matches: tuple[str, ...], *, several: bool, indefinite: bool) -> Resolved:
    """`matches` as the quantifier or article of `phrase` counts them."""
    if phrase.startswith("both") and len(matches) != 2:
        return Unclear(f'"{phrase}" does not name two objects')
    if several or len(matches) == 1:
        return Found(matches)
    return Found(matches, 1) if indefinite else Unclear(f'"{phrase}" may be {" or ".join(matches)}')


def _matches(words: Sequence[str], obj: SceneObject) -> bool:
    """Whether the adjectives are colours of `obj` and the noun is its category, its name or a general noun."""
    *adjectives, noun = words
    if obj.name == noun and not adjectives:
        return True
    colour = {obj.colour, {"gray": "grey"}.get(obj.colour, obj.colour)}
    nouns = {obj.category, obj.name.rsplit("_", 1)[-1], obj.name}
    head = noun in nouns or _singular(noun) in nouns or _singular(noun) in GENERIC_NOUNS
    reds = noun in colour and not adjectives
    return reds or (head and all({"gray": "grey"}.get(word, word) in colour for word in adjectives))


def _missing(words: Sequence[str], objects: Sequence[SceneObject]) -> Resolved:
    """No object is called so: it is absent, unless another word for an object of the scene may be meant."""
    phrase, noun = " ".join(words), _singular(words[-1])
    if any(word in PERSONS for word in words):
        return Unclear(f'"{phrase}" is a person')
    if not _is_noun_phrase(words, objects):
        return Unclear(f'"{phrase}" is no name of an object')
    colours = [word for word in words[:-1] if word in COLOURS]
    others = [word for word in words[:-1] if word not in COLOURS]
    kin = next((group for group in SYNONYMS if noun in group), frozenset({noun}))
    similar = [obj for obj in objects if obj.category in kin and all(word == obj.colour for word in colours)]
    if len(similar) == 1 and noun in GENERAL_CONTAINERS and not others:
        return Found((similar[0].name,))
    if similar:
        return Unclear(f'"{phrase}" may be another name of {similar[0].name}')
    if others and any(obj.category == noun for obj in objects):
        return Unclear(f'"{" ".join(others)}" is no property by which the parser distinguishes objects')
    return Absent(phrase)


def _is_noun_phrase(words: Sequence[str], objects: Sequence[SceneObject]) -> bool:
    """Whether `words` may be the name of one more object: at most one adjective and a noun, nothing structural."""
    known = {obj.category for obj in objects}
    return (
        len(words) <= MAX_WORDS
        and all(re.fullmatch(r"[a-z]+", word) for word in words)
        and not any(word in NO_OBJECTS for word in words)
        and not any(word in known for word in words[:-1])
    )


_OTHER_NOUNS = GENERIC_NOUNS | GENERAL_CONTAINERS | frozenset[str]().union(*SYNONYMS)
"""Nouns that name things in any scene: "block" is no misspelled "black"."""


def _corrected(word: str, known: frozenset[str]) -> str:
    """`word`, or the known word that it misspells."""
    if (function_word := corrected_function_word(word)) != word:
        return function_word
    if exchanged := next((one for one in sorted(known) if are_letters_exchanged(word, one)), ""):
        return exchanged
    spelled = known | COLOURS | _OTHER_NOUNS
    if len(word) < MIN_CORRECTED or word in spelled or _singular(word) in spelled:
        return word
    return next((one for one in sorted(known) if is_one_edit_away(word, one)), word)


def _singular(noun: str) -> str:
    """The singular of a regular plural; boxes: box, cubes: cube, glasses: glass, dishes: dish."""
    if re.search(r"(?:ss|x|sh|ch)es$", noun):
        return noun[:-2]
    return noun[:-1] if noun.endswith("s") and not noun.endswith("ss") else noun
