"""The manner of an instruction: its words that are no part of the goal, such as an amount, a duration or care."""

from __future__ import annotations

import re
from dataclasses import dataclass

from dualbrain.grounding.instruction.goals import goal_words
from dualbrain.grounding.instruction.words import normalise

_CAUTIONS = re.compile(rf"(?<![^\s,])(?:{goal_words.CAUTIONS})(?=$|[\s,])")
_COURTESIES = re.compile(rf"(?<![^\s,])(?:{goal_words.REQUESTS}|{goal_words.COURTESIES})(?=$|[\s,])")
_VERBS = frozenset(f"{goal_words.PLACING_VERBS}|{goal_words.LIFTING_VERBS}".replace("|", " ").split())


@dataclass(frozen=True, slots=True)
class Manner:
    """The expressions that ask for care, such as "slowly", and all other words that are no part of the goal."""

    cautions: frozenset[str]
    words: frozenset[str]

    def serves(self, asked: Manner) -> bool:
        """Whether a contract for an instruction in this manner also serves one in the manner `asked`.

        All other words must be the same. More care than `asked` is allowed, less is not.
        """
        return self.words == asked.words and asked.cautions <= self.cautions


def read_manner(instruction: str, names: set[str]) -> Manner:
    """The manner of `instruction`; the words of `names`, of verbs of a placement and of courtesy are left out."""
    text = " ".join(instruction.lower().replace("’", "'").rstrip(" .!").split())
    cautions = frozenset(match.group() for match in _CAUTIONS.finditer(text))
    rest = _COURTESIES.sub(" ", _CAUTIONS.sub(" ", text))
    of_names = {word for name in names for word in name.split("_")}
    words = frozenset(word for word in normalise(rest).text.split() if word[0].isalnum())
    return Manner(cautions, words - of_names - _VERBS - goal_words.STRUCTURE_WORDS)
