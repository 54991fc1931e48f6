"""Numbers in an instruction for the parameters of skills: speeds, forces, heights, lengths of a push, times.

"Push the tin 8 cm towards the bowl at 0.1 m/s" states a distance of 0.08 m and a speed of 0.1 m/s. A contract whose
numbers differ does not carry out the instruction.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from dualbrain.grounding.instruction.words import NUMBER_WORDS

StatedParameter = Literal["speed", "force", "clearance", "distance", "duration"]
UNITS: dict[StatedParameter, str] = {"speed": "m/s", "force": "N", "clearance": "m", "distance": "m", "duration": "s"}
PARAMETER_NAMES: dict[StatedParameter, tuple[str, ...]] = {
    "speed": ("speed", "max_speed"),
    "force": ("force",),
    "clearance": ("clearance",),
    "distance": ("distance",),
    "duration": ("duration",),
}
"""The names that parameters of skills have."""
TOLERANCE = 0.1
"""A number that is no bound admits numbers within this fraction of it."""
_WORDS = NUMBER_WORDS | {"a": 1.0, "an": 1.0, "half a": 0.5, "half an": 0.5}
_METRES = {"mm": 0.001, "cm": 0.01, "m": 1.0, "inch": 0.0254, "millimet": 0.001, "centimet": 0.01, "met": 1.0}
_AT_MOST = (
    r"at most|(?:no|not) (?:more|faster|harder|higher) than|(?:less|slower) than|under|below|up to|max(?:imum)?(?: of)?"
    r"|only|just"
)
_NUMBER = (
    rf"(?:(?P<most>{_AT_MOST}) )?(?:(?:about|around|roughly|exactly) )?"
    rf"\b(?P<number>\d{{1,4}}(?:[.,]\d{{1,3}})?|{'|'.join(sorted(_WORDS, key=len, reverse=True))})"
)
_GAP = r"(?: |(?<=\d))"
"""Between a number and its unit: a space, or nothing after a digit."""
_LENGTH = r"(?P<unit>mm|cm|m|inch(?:es)?|millimet(?:er|re)s?|centimet(?:er|re)s?|met(?:er|re)s?)"
_SPEED = re.compile(rf"{_NUMBER}{_GAP}{_LENGTH} ?(?:/|per|an?|each|every|in one) ?(?:s|sec|second)\b")
_FORCE = re.compile(rf"{_NUMBER}{_GAP}(?:n|newtons?)\b")
_DURATION = re.compile(rf"(?!\ban? sec){_NUMBER}{_GAP}(?:s|secs?|seconds?)\b")
"""A time; "a second" is an idiom."""
_DISTANCE = re.compile(rf"{_NUMBER}{_GAP}{_LENGTH}\b")
_PATTERNS: dict[StatedParameter, re.Pattern[str]] = {"speed": _SPEED, "force": _FORCE, "duration": _DURATION}
"""In this order, so that the "s" of a speed is no duration."""
_CLAUSE_END = re.compile(r"[,.;:!?](?!\d)|\b(?:and|then)\b")
_PUSH = re.compile(r"\b(?:push|shove|slide|nudge|scoot|budge|shift)\w*\b")
_HEIGHT = re.compile(r"\b(?:lift|raise|pick|hover|clearance|height|high|above|up|off|carry|grab|grip|take|hold)\w*\b")

_ANY_NUMBER = rf"(?:\d{{1,4}}(?:[.,]\d{{1,3}})?|{'|'.join(sorted(_WORDS, key=len, reverse=True))}){_GAP}"
_ANY_LENGTH = _LENGTH.replace("?P<unit>", "?:")
_BOUND = rf"(?:(?:{_AT_MOST}|about|around|roughly|exactly) )?"
VALUE_PHRASES = re.compile(
    rf",? ?(?:\b(?:at|with|using|by) )?(?:\ba )?(?:\b(?:top |low )?(?:speed|velocity|pace) (?:of |at )?)?{_BOUND}"
    rf"\b{_ANY_NUMBER}{_ANY_LENGTH} ?(?:/|per|an?) ?(?:s|sec|second)\b(?: speed)?"
    rf"|,? ?(?:\b(?:with|using|at) )?(?:\ba )?(?:\b(?:grip(?:ping)? force|grip|force|pressure) (?:of )?)?{_BOUND}"
    rf"\b{_ANY_NUMBER}(?:n|newtons?)\b(?: of (?:grip force|grip|force|pressure))?"
    rf"|,? ?\b(?:with|at|and) (?:a )?(?:clearance |height )?(?:of )?{_BOUND}{_ANY_NUMBER}{_ANY_LENGTH} (?:of )?"
    r"(?:clearance|high|up|above the table|off the table|over the table)\b"
    rf"|,? ?\b(?:with )?(?:a )?(?:lift(?:ing)? )?(?:height|clearance) (?:of )?{_BOUND}{_ANY_NUMBER}{_ANY_LENGTH}\b"
)
"""Phrases with a speed, a force or a height, without which an instruction keeps its objects and destinations."""


@dataclass(frozen=True, slots=True)
class StatedValue:
    """A number for `parameter` in SI units; with `at_most` it is an upper bound, else the number that is meant."""

    parameter: StatedParameter
    value: float
    at_most: bool = False

    @property
    def bounds(self) -> tuple[float, float]:
        """The least and the largest number that the words admit."""
        if self.at_most:
            return 0.0, self.value
        return (1.0 - TOLERANCE) * self.value, (1.0 + TOLERANCE) * self.value

    def admits(self, number: float) -> bool:
        """Whether a contract may state `number`."""
        least, most = self.bounds
        return least - 1e-9 <= number <= most + 1e-9

    def __str__(self) -> str:
        """As in "a speed of at most 0.1 m/s"."""
        bound = "at most " if self.at_most else ""
        return f"a {self.parameter} of {bound}{self.value:.3g} {UNITS[self.parameter]}"


def stated_values(text: str) -> tuple[StatedValue, ...]:
    """The numbers for parameters in `text` in normal form, in the order of the parameters."""
    rest, found = text, list[StatedValue]()
    for parameter, pattern in _PATTERNS.items():
        found += [_value(parameter, match) for match in pattern.finditer(rest)]
        rest = pattern.sub(_blank, rest)
    found += _lengths(rest)
    return tuple(dict.fromkeys(found))


def _blank(match: re.Match[str]) -> str:
    return " " * len(match[0])


def _lengths(text: str) -> Iterator[StatedValue]:
    """Heights and lengths of pushes: the words of their clause state which."""
    for match in _DISTANCE.finditer(text):
        starts = [one.end() for one in _CLAUSE_END.finditer(text, 0, match.start())]
        end = _CLAUSE_END.search(text, match.end())
        clause = text[starts[-1] if starts else 0 : end.start() if end else len(text)]
        if _PUSH.search(clause):
            yield _value("distance", match)
        elif _HEIGHT.search(clause):
            yield _value("clearance", match)


def _value(parameter: StatedParameter, match: re.Match[str]) -> StatedValue:
    number = match["number"].replace(",", ".")
    value = float(number) if number[0].isdigit() else _WORDS[number]
    if "unit" in match.re.groupindex:
        unit = re.sub(r"(?:er|re)s?$|(?<=inch)es$", "", match["unit"])
        value *= _METRES[unit]
    return StatedValue(parameter, value, match["most"] is not None)
