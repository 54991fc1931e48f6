"""Names of objects and places in the words of a person.

A scene name such as "red_cube" is a list of words, and its last word is a category. A person may leave out the color,
use another word for the category, or speak of a group. Places may have other orders: "left side of the table" is
`table_left`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

from dualbrain.grounding.instruction.words import is_one_edit_away

SIDES = ("left", "right", "front", "back", "middle", "center")
"""Words that turn the name of a thing into the name of a part of it."""
COLORS = frozenset(
    {"red", "blue", "green", "yellow", "orange", "purple", "violet", "teal", "turquoise", "cyan", "white", "brown"}
    | {"gray", "pink", "black", "clear", "transparent", "silver", "gold", "beige", "magenta", "oak", "ivory"}
)
COLOR_SYNONYMS: Mapping[str, tuple[str, ...]] = {
    "purple": ("violet", "lilac"),
    "teal": ("turquoise", "cyan", "aqua"),
    "clear": ("transparent", "see through"),
    "gray": ("silver",),
    "pink": ("rose",),
}
CATEGORY_SYNONYMS: Mapping[str, tuple[str, ...]] = {
    "cube": ("block", "brick", "box", "die", "dice"),
    "block": ("cube", "brick", "cuboid", "bar"),
    "box": ("carton", "package", "case", "packet"),
    "carton": ("box", "package", "packet", "pack"),
    "can": ("tin", "drink", "soda"),
    "tin": ("can",),
    "bottle": ("flask",),
    "glass": ("cup", "tumbler", "mug", "drinking glass"),
    "cup": ("mug", "glass"),
    "mug": ("cup", "glass"),
    "bowl": ("dish", "container", "basin"),
    "tray": ("container", "dish"),
    "basket": ("container", "bin"),
    "bin": ("container", "basket"),
    "parcel": ("package", "box", "packet"),
    "crate": ("box",),
    "charger": ("charging station", "charging place", "charging point", "charging dock", "dock", "charging spot"),
    "shelf": ("rack", "shelves", "shelving"),
    "bench": ("workbench", "work bench", "bank"),
}
"""Other words for a category; a word that is itself the category of a thing in the scene means that thing first."""
GENERIC = frozenset(
    {"thing", "object", "item", "piece", "stuff", "one", "it", "this", "that", "them", "these", "those"}
)
"""Words for an object that name no category."""

_SOURCE = re.compile(r"\b(?:from|out of|off|inside of)(?: (?:the|that|this|my|your))?(?: \w+)?\s*$")
COMMON_WORDS = frozenset(
    [
        "bow",
        "bowling",
        "cute",
        "cure",
        "cub",
        "tube",
        "rube",
        "cake",
        "case",
        "care",
        "cast",
        "cost",
        "chest",
        "shell",
        "self",
        "bunch",
        "branch",
        "table",
        "cable",
        "able",
        "block",
        "box",
        "back",
        "black",
        "blocked",
        "down",
        "bottled",
        "bring",
        "brick",
        "shelves",
        "glasses",
        "class",
        "grass",
        "plus",
        "please",
        "place",
        "put",
    ]
) - {"cub"}
"""English words that are one letter away from the name of a category, and do not mean it."""


def singular(word: str) -> str:
    """The singular of a regular plural, such as "boxes" or "cubes"; other words are returned as they are."""
    for ending, stem in (("shelves", "shelf"), ("glasses", "glass"), ("dishes", "dish"), ("boxes", "box")):
        if word == ending:
            return stem
    if len(word) > 3 and word.endswith("s") and not word.endswith("ss"):
        return word[:-1]
    return word


def name_words(name: str) -> tuple[str, ...]:
    """The words of a scene name in normal form, without numbers: ("brown", "parcel") for "brown_parcel_2"."""
    parts = (part for part in name.lower().split("_") if part and not part.isdigit())
    return tuple("gray" if part == "grey" else part for part in parts)


def category_of(name: str) -> str:
    """The category of a scene name: its last word that is no color and no side."""
    words = [word for word in name_words(name) if word not in COLORS and word not in SIDES]
    return words[-1] if words else name_words(name)[-1] if name_words(name) else name


def category_words(names: Sequence[str]) -> frozenset[str]:
    """All words by which a person may call the categories of `names`."""
    found: set[str] = set()
    for name in names:
        category = category_of(name)
        found |= {category, *CATEGORY_SYNONYMS.get(category, ())}
    return frozenset(found)


def mask_places(text: str, places: Sequence[str], *, sides_alone: bool = False) -> str:
    """`text` in normal form, with all mentions of places by their side replaced by as many letters "n".

    With `sides_alone`, also "the left" where one place has this side.
    """
    patterns = [side_pattern(place) for place in places]
    if sides_alone:
        patterns += [side_alone_pattern(place, tuple(places)) for place in places]
    for pattern in patterns:
        if pattern is not None:
            text = pattern.sub(lambda match: "n" * len(match[0]), text)
    return text


@lru_cache(maxsize=256)
def side_pattern(place: str) -> re.Pattern[str] | None:
    """The mentions of a place whose name has a side, such as "left side of the table", "table left", "left table"."""
    words = name_words(place)
    side = next((word for word in words if word in SIDES), None)
    thing = " ".join(word for word in words if word != side)
    if side is None or not thing:
        return None
    part = r"(?: hand)?(?: (?:side|part|end|half|area|section|edge|portion|corner))?"
    a, b = re.escape(side), re.escape(thing)
    return re.compile(
        rf"\b{a}{part} (?:of|on|at) (?:the |this |that |my |our )?{b}\b|\b{b} (?:on the |to the |at the )?{a}{part}\b"
        rf"|\b{b} 's {a}{part}\b|\b{b}'s {a}{part}\b|\b{a}{part} {b}\b"
    )


@lru_cache(maxsize=256)
def side_alone_pattern(place: str, places: tuple[str, ...]) -> re.Pattern[str] | None:
    """The mentions of a place by its side alone, such as "the left"; None if several places have this side."""
    side = next((word for word in name_words(place) if word in SIDES), None)
    if side is None or sum(side in name_words(other) for other in places) > 1:
        return None
    return re.compile(
        rf"(?:(?<=\bthe )|(?<=, )|(?<=: )|(?<=\bthen )|(?<=\band )|^){side}"
        r"(?! (?:side|part|half|hand|end|corner|edge|area|section|portion|of|one|the|it|my|most)\b)(?=\W|$)"
    )


@dataclass(frozen=True, slots=True)
class Mention:
    """One mention of something in the text: the scene names that it may mean, and whether it means all or any of them.

    `source` states that the text speaks of taking something out of it or off it.
    """

    names: tuple[str, ...]
    several: bool = False
    source: bool = False


def describes_object(phrase: str) -> bool:
    """Whether a word of `phrase` is a color, or a category of objects, in any scene."""
    categories = {*CATEGORY_SYNONYMS, *(one for some in CATEGORY_SYNONYMS.values() for one in some)}
    return any(word in COLORS or singular(word) in categories for word in phrase.lower().split())


def find_mentions(text: str, names: Sequence[str]) -> tuple[Mention, ...]:
    """The mentions of scene `names` in a text in normal form.

    A category and a color in front of it select the names of both; a synonym selects a category unless it is itself the
    category of something in the scene with that color.
    """
    found: list[Mention] = []
    for name in names:
        for pattern in (side_pattern(name), side_alone_pattern(name, tuple(names))):
            if pattern is not None and (match := pattern.search(text)):
                found.append(Mention((name,), source=_is_source(text[: match.start()])))
    text = mask_places(text, names)
    for phrase, nouns in _phrases(tuple(dict.fromkeys(map(category_of, names)))).items():
        for match in re.finditer(rf"\b{re.escape(phrase)}\b", text):
            found += _mention(text, match.start(), match.end(), nouns, names)
    words = list(re.finditer(r"[^\W\d_]+", text))
    for match in words:
        found += _mention_of_word(text, match, names)
    return tuple(found)


def _phrases(categories: tuple[str, ...]) -> dict[str, frozenset[str]]:
    """Synonyms of several words, with the categories that they mean."""
    found: dict[str, frozenset[str]] = {}
    for category in categories:
        for synonym in CATEGORY_SYNONYMS.get(category, ()):
            if " " in synonym:
                found[synonym] = found.get(synonym, frozenset()) | {category}
    return found


def _mention_of_word(text: str, match: re.Match[str], names: Sequence[str]) -> list[Mention]:
    word = singular(match[0])
    plural = word != match[0]
    if word in GENERIC:
        return _mention(
            text, match.start(), match.end(), frozenset(), names, plural=plural or match[0] in ("them", "stuff")
        )
    categories = {category_of(name) for name in names}
    if word in categories:
        mentions = _mention(text, match.start(), match.end(), frozenset({word}), names, plural=plural)
        if mentions and mentions[0].names:
            return mentions
    synonyms = frozenset(name for name in categories if word in CATEGORY_SYNONYMS.get(name, ()))
    if synonyms:
        return _mention(text, match.start(), match.end(), synonyms, names, plural=plural)
    if word in COMMON_WORDS or word in COLORS:
        return []
    near = frozenset(name for name in categories if len(name) > 3 and is_one_edit_away(word, name))
    return _mention(text, match.start(), match.end(), near, names, plural=plural) if near else []


def _mention(
    text: str, start: int, end: int, nouns: frozenset[str], names: Sequence[str], *, plural: bool = False
) -> list[Mention]:
    """The mention of `nouns` (() for any category) at `text[start:end]`, with the color in front of it."""
    before = text[max(0, start - 80) : start].split()[-6:]
    colors = _colors(before)
    if not nouns and not colors:
        return []
    fitting = tuple(
        name
        for name in names
        if (not nouns or category_of(name) in nouns) and (not colors or colors & set(name_words(name)))
    )
    several = plural or len(colors) > 1 or bool({"all", "every", "each", "any", "a", "an", "some"} & set(before[-4:]))
    return [Mention(fitting, several, _is_source(text[:start]))] if fitting else []


def _colors(before: Sequence[str]) -> set[str]:
    """The colors in front of a noun: "red", "red and yellow", or "red" with one word between."""
    found: set[str] = set()
    for word in reversed(before):
        color = color_of(word)
        if color:
            found.add(color)
        elif word not in ("and", ",", "or"):
            break
    if not found and len(before) > 1 and (color := color_of(before[-2])):
        found.add(color)
    return found


def color_of(word: str) -> str:
    """The color that `word` names, as scenes name it; "" for other words."""
    if word in COLORS and word not in {synonym for some in COLOR_SYNONYMS.values() for synonym in some}:
        return word
    return next(
        (color for color, synonyms in COLOR_SYNONYMS.items() if word in synonyms), word if word in COLORS else ""
    )


def _is_source(before: str) -> bool:
    return _SOURCE.search(before[-60:]) is not None
