"""The words of an instruction in a normal form, with their positions in the original text.

Normal form: lower case, contractions and common misspellings of function words replaced, words and punctuation marks
separated by single spaces. "Don't put it in the bowl." becomes "do not put it in the bowl .".
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator
from dataclasses import dataclass

from dualbrain.core.untrusted.hidden_characters import is_hidden_character, remove_hidden_characters

NUMBER_WORDS = {
    **{"one": 1, "two": 2, "three": 3, "four": 4, "five": 5, "six": 6, "seven": 7, "eight": 8, "nine": 9, "ten": 10},
    **{"eleven": 11, "twelve": 12, "fifteen": 15, "twenty": 20, "thirty": 30, "forty": 40, "fifty": 50},
}
"""The numbers that instructions state as a word."""
_TOKEN = re.compile(r"\d+(?:[.,]\d+)?|[^\W\d_]+(?:'[^\W\d_]+)*|[^\w\s'_-]")
_SPACE = re.compile(r"\s")
_DIVISION = re.compile(r"[a-zA-Z0-9]\0+[a-zA-Z0-9]")
_APOSTROPHES = dict.fromkeys(map(ord, "\u2018\u2019\u02bc\u00b4`\u2032"), "'")
_CONTRACTIONS = {
    "dont": "do not",
    "doesnt": "does not",
    "didnt": "did not",
    "cant": "can not",
    "cannot": "can not",
    "can't": "can not",
    "won't": "will not",
    "wont": "will not",
    "shan't": "shall not",
    "isnt": "is not",
    "arent": "are not",
    "shouldnt": "should not",
    "mustnt": "must not",
    "thats": "that is",
    "havent": "have not",
    "hasnt": "has not",
    "wasnt": "was not",
    "youre": "you are",
    "theyre": "they are",
    "ive": "i have",
    "im": "i am",
    "i'm": "i am",
    "i'd": "i would",
    "i'll": "i will",
    "lets": "let us",
    "let's": "let us",
    "gimme": "give me",
    "lemme": "let me",
    "it's": "it is",
    "that's": "that is",
    "there's": "there is",
    "what's": "what is",
    "where's": "where is",
    "you're": "you are",
    "you've": "you have",
    "i've": "i have",
    "we're": "we are",
    "we've": "we have",
    "they're": "they are",
    "they've": "they have",
    "w/o": "without",
}
_COMMON_WORDS = (
    "could", "would", "should", "please", "that", "this", "with", "them", "into", "onto", "table", "left", "right",
    "front", "side", "place", "move", "bring", "drop", "take", "carry", "push",
)  # fmt: skip
"""Words in which exchanged letters are corrected; no exchange gives another word."""
MISSPELLINGS = {
    "mv": "move",
    "ontop": "on top",
    "tabel": "table",
    "blok": "block",
    "hoem": "home",
    "twoards": "towards",
    "towrds": "towards",
    "twd": "towards",
    "twds": "towards",
    "til": "until",
    "till": "until",
    "untill": "until",
    "unitl": "until",
    "wile": "while",
    "whlie": "while",
    "whiel": "while",
    "wen": "when",
    "wehn": "when",
    "whne": "when",
    "hwen": "when",
    "iff": "if",
    "whn": "when",
    "nex": "next",
    "nxt": "next",
    "nect": "next",
    "lef": "left",
    "letf": "left",
    "rihgt": "right",
    "rigth": "right",
    "rigt": "right",
    "bihind": "behind",
    "behined": "behind",
    "inbetween": "between",
    "befor": "before",
    "bfore": "before",
    "evry": "every",
    "everytime": "every time",
    "evrytime": "every time",
    "anytime": "any time",
    "nto": "not",
    "noot": "not",
    "nver": "never",
    "ot": "to",
    "teh": "the",
    "hte": "the",
    "pls": "please",
    "plz": "please",
    "toward": "towards",
    "bth": "both",
    "boht": "both",
    "twise": "twice",
    "nearst": "nearest",
    "bigest": "biggest",
    "biger": "bigger",
    "u": "you",
    "exept": "except",
    "execpt": "except",
    "ecxept": "except",
    "eather": "either",
    "ether": "either",
    "grey": "gray",
    "colour": "color",
    "colours": "colors",
    "centre": "center",
}
_FUZZY_WORDS = (
    "until",
    "unless",
    "without",
    "between",
    "behind",
    "before",
    "except",
    "whenever",
    "either",
    "repeat",
    "repeatedly",
    "instead",
    "beside",
    "smallest",
    "biggest",
    "nearest",
    "tallest",
)
"""Function words that are also recognised with one letter missing, added, replaced, or exchanged with the next."""
_NEVER_FUZZY = frozenset({"neither", "lither", "beside", "besides", "repeats", "withouts", "excepts", "reheat"})


@dataclass(frozen=True, slots=True)
class Words:
    """An instruction in normal form: `text`, and for every character of it the position in the `original`."""

    original: str
    text: str
    _starts: tuple[int, ...]
    _ends: tuple[int, ...]

    def quote(self, start: int, end: int) -> str:
        """The original words of `text[start:end]`."""
        covered = range(max(0, start), min(end, len(self.text)))
        if not covered:
            return ""
        first, last = self._starts[covered[0]], self._ends[covered[-1]]
        return " ".join(self.original[first:last].split())


def without_hidden_characters(instruction: str) -> str:
    """`instruction` without the characters that a reader does not see; line ends and tabs become spaces."""
    return remove_hidden_characters(_SPACE.sub(" ", instruction))


def has_hidden_division(instruction: str) -> bool:
    """Whether hidden characters stand between two letters or digits, so that what is read depends on the reader."""
    if instruction.isprintable():
        return False
    shown = "".join("\0" if is_hidden_character(character) else character for character in _SPACE.sub(" ", instruction))
    return _DIVISION.search(shown) is not None


def normalise(instruction: str) -> Words:
    """The normal form of `instruction` without hidden characters; the time is linear in its length."""
    original = unicodedata.normalize("NFKC", without_hidden_characters(instruction)).translate(_APOSTROPHES)
    parts: list[str] = []
    starts: list[int] = []
    ends: list[int] = []
    for match in _TOKEN.finditer(original):
        for word in _expand(match[0].lower()).split():
            parts.append(word)
            spaced = len(word) + 1  # the space after a word belongs to it
            starts += [match.start()] * spaced
            ends += [match.end()] * spaced
    text = " ".join(parts)
    return Words(original, text, tuple(starts[: len(text)]), tuple(ends[: len(text)]))


def _expand(word: str) -> str:
    if word in _CONTRACTIONS:
        return _CONTRACTIONS[word]
    if word.endswith("n't"):
        return f"{word[:-3]} not"
    corrected = corrected_function_word(word)
    return _nearest_function_word(word) if corrected == word else corrected


def corrected_function_word(word: str) -> str:
    """The function word that `word` commonly misspells, or in which two neighbouring letters are exchanged."""
    if word in MISSPELLINGS:
        return MISSPELLINGS[word]
    return next((known for known in _COMMON_WORDS if are_letters_exchanged(word, known)), word)


def are_letters_exchanged(word: str, known: str) -> bool:
    """Whether two neighbouring letters of a `known` word of at least four are exchanged, not the first one."""
    return (
        len(known) >= 4
        and len(word) == len(known)
        and word != known
        and (sorted(word) == sorted(known) and is_one_edit_away(word, known))
    )


def _nearest_function_word(word: str) -> str:
    if len(word) < 5 or word in _NEVER_FUZZY or word in _FUZZY_WORDS:
        return word
    return next((known for known in _FUZZY_WORDS if is_one_edit_away(word, known)), word)


def is_one_edit_away(word: str, known: str) -> bool:
    """Whether one letter is missing, added or replaced, or two neighbours are exchanged."""
    if word[0] != known[0] or abs(len(word) - len(known)) > 1:
        return False
    first = next((i for i, (a, b) in enumerate(zip(word, known, strict=False)) if a != b), min(len(word), len(known)))
    rest, other = word[first:], known[first:]
    return (
        rest[1:] == other[1:]
        or rest[1:] == other
        or rest == other[1:]
        or (rest[:2] == other[1::-1] and rest[2:] == other[2:])
    )


def sentences(text: str) -> Iterator[tuple[int, int]]:
    """Start and end of each sentence of a text in normal form; the point of a decimal number ends none."""
    start = 0
    for match in re.finditer(r"[.!?;](?!\d)", text):
        yield start, match.end()
        start = match.end()
    if start < len(text):
        yield start, len(text)
