"""Words of an instruction that identify objects and places of one scene."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

from dualbrain.grounding.instruction.names import Mention, find_mentions, side_pattern

PLACEHOLDER, FILLER = "n", "x"
"""Letters that replace the mention of a place, and words that no rule needs to read."""
_PLACEHOLDERS = re.compile(rf"\b{PLACEHOLDER}{{4,}}\b")
_DETERMINER = re.compile(r"\b(?:the|that|this|my|our|your|only) (?=[^.,;:!?]*$)")
_GENERIC_NOUN = re.compile(r"\b(?:thing|object|item|one|piece)$")
_OUTSIDE = re.compile(
    r"\b(?:and|or|not|but|then|in|into|inside|onto|to|on|at|of|with|from|is|are|it|put|place|move|bring|should|must|goes)\b"
)
"""Words that no simple noun phrase contains."""
_LONGEST_PHRASE = 80
MAX_MATCHES = 20


def fill(text: str, start: int, end: int, letter: str = FILLER) -> str:
    """`text` with `letter` in place of each character from `start` to `end`, so that positions stay valid."""
    return text[:start] + letter * (end - start) + text[end:]


@dataclass(frozen=True, slots=True)
class SceneWords:
    """The names of a scene: what the hand can take, and where things can go. No graspable names: they are not known."""

    graspable: Sequence[str] = ()
    receptive: Sequence[str] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """All names of the scene."""
        return (*self.graspable, *self.receptive)

    def mentions(self, text: str, names: Sequence[str]) -> tuple[Mention, ...]:
        """The mentions of `names` in a text whose places may already be masked."""
        return find_mentions(text, names)

    def identify(self, phrase: str) -> str | None:
        """The only thing of the scene that a noun phrase such as "the green tin" can mean; None if there is no such."""
        found = {(one.names, one.several) for one in self.mentions(phrase, self.names)}
        if len(found) == 1:
            ((names, several),) = found
            return names[0] if len(names) == 1 and not several else None
        if not found and len(self.graspable) == 1 and _GENERIC_NOUN.search(phrase):
            return self.graspable[0]
        return None

    def has_destination(self, text: str) -> bool:
        """Whether `text` mentions a container or a place of the scene."""
        if _PLACEHOLDERS.search(text):
            return True
        return any(not mention.source for mention in self.mentions(text, self.receptive))

    def has_side(self, side: str) -> bool:
        """Whether exactly one place of the scene has the side "left", "right", "front", "back" or "middle"."""
        return sum(side_pattern(name) is not None and side in name.split("_") for name in self.receptive) == 1


def first_matches(pattern: re.Pattern[str], text: str) -> Iterator[re.Match[str]]:
    """The first `MAX_MATCHES` matches: each one is looked up in the scene, and further ones remain as they are."""
    return islice(pattern.finditer(text), MAX_MATCHES)


def noun_phrase_before(text: str, position: int) -> str | None:
    """The noun phrase that ends at `position`, from its determiner on: "the green tin"; None if there is none."""
    before = text[max(0, position - _LONGEST_PHRASE) : position].rstrip(" ,")
    starts = [match.start() for match in _DETERMINER.finditer(before)]
    phrase = before[starts[-1] :] if starts else ""
    return phrase if phrase and phrase.count(" ") <= 4 and not _OUTSIDE.search(phrase) else None
