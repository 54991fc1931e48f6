"""The manner of an instruction: its words that are no part of the goal, such as an amount, a duration or care."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass

from dualbrain.grounding.instruction.goals import goal_words
from dualbrain.grounding.instruction.goals.goal_reading import MAX_CHARACTERS
from dualbrain.grounding.instruction.words import normalise

_CAUTIONS = re.compile(rf"(?<![^\s,])(?:very )*(?:{goal_words.CAUTIONS})(?=$|[\s,])")
_COURTESIES = re.compile(rf"(?<![^\s,])(?:{goal_words.REQUESTS}|{goal_words.COURTESIES})(?=$|[\s,])")
_VERBS = frozenset(f"{goal_words.PLACING_VERBS}|{goal_words.LIFTING_VERBS}".replace("|", " ").split())
_GERUNDS = frozenset(gerund for gerund, verb in goal_words.GERUNDS.items() if verb in _VERBS)
_UNIMPORTANT = _VERBS | _GERUNDS | goal_words.STRUCTURE_WORDS


@dataclass(frozen=True, slots=True)
class Manner:
    """The expressions that ask for care, such as "slowly", and all other words outside the goal, in order."""

    cautions: frozenset[str]
    words: tuple[str, ...]

    def serves(self, asked: Manner) -> bool:
        """Whether a contract for an instruction in this manner also serves one in the manner `asked`.

        All other words must be the same in the same order. More care than `asked` is allowed, less is not.
        """
        return self.words == asked.words and asked.cautions <= self.cautions


def read_manner(instruction: str, names: Collection[str]) -> Manner:
    """The manner of an `instruction` of a single clause.

    Left out are the `names`, words of courtesy and of a wish, and verbs and prepositions of a placement. A number that
    is no part of a whole name is kept. A text that is too long for the goal parser is one word, unlike any other.
    """
    if len(instruction) > MAX_CHARACTERS:
        return Manner(frozenset(), (instruction,))
    text = " ".join(instruction.lower().replace("’", "'").rstrip(" .!?").split())
    cautions = frozenset(match.group() for match in _CAUTIONS.finditer(text))
    text = _COURTESIES.sub(" ", _CAUTIONS.sub(" ", text))
    for name in sorted(names, key=len, reverse=True):
        text = re.sub(rf"\b{'[ _]'.join(map(re.escape, name.lower().split('_')))}\b", " ", text)
    of_names = {
        word for name in names for word in name.lower().split("_") if word.isalpha()
    } - goal_words.NUMBERS.keys()
    words = (word for word in normalise(text).text.split() if word[0].isalnum())
    return Manner(cautions, tuple(word for word in words if word not in of_names | _UNIMPORTANT))
