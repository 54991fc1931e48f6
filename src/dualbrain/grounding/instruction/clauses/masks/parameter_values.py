"""Numbers that a parameter of a skill expresses: "at no more than 0.1 m/s", "with at most 5 N"."""

from __future__ import annotations

import re

from dualbrain.grounding.instruction.clauses.expressible import Capabilities
from dualbrain.grounding.instruction.clauses.rules.clause_rule import Capability
from dualbrain.grounding.instruction.clauses.rules.word_classes import NUMBER
from dualbrain.grounding.instruction.clauses.scene_words import fill, first_matches

_BOUND = (
    r"(?:(?:at most|at least|no (?:more|less) than|not more than|less than|under|below|above|faster than"
    r"|slower than|harder than|up to|about|around|exactly"
    r"|only|just|a maximum of|a minimum of) )?"
)
_LENGTH = r"(?:mm|cm|m|millimet(?:er|re)s?|centimet(?:er|re)s?|met(?:er|re)s?)"
_SPEED = re.compile(
    rf"\b(?:at |with )?(?:a (?:\w+ )?(?:speed|velocity|pace) of )?{_BOUND}(?:{NUMBER}|half an?) {_LENGTH} (?:/|per"
    rf"|an?) s(?:ec(?:ond)?)?\b"
)
_FORCE = re.compile(rf"\b(?:with )?(?:a (?:\w+ )?(?:force|grip) of )?{_BOUND}{NUMBER} (?:n|newtons?)\b")
_HEIGHT = re.compile(
    rf"\b(?:carry|keep|stay|remain|fly|travel|move)\b[^.;!?]{{0,60}}?(?P<value>(?:at a height of"
    rf" {_BOUND}{NUMBER} {_LENGTH}"
    rf"|with a clearance of {_BOUND}{NUMBER} {_LENGTH}|{_BOUND}{NUMBER} {_LENGTH} (?:high|above|over)(?= |$))"
    r"(?: (?:above )?(?:the (?:table|ground|floor|desk|surface)|everything))?)"
)
_VALUES: tuple[tuple[Capability, re.Pattern[str]], ...] = (
    ("speed", _SPEED),
    ("force", _FORCE),
    ("clearance", _HEIGHT),
)


def mask_parameter_values(text: str, abilities: Capabilities) -> str:
    """`text` with the letter x in place of each speed, force and carrying height that the skills of a robot take.

    The gate checks that the number lies within the bounds of the parameter.
    """
    for capability, pattern in _VALUES:
        if capability not in abilities.names:
            continue
        for match in first_matches(pattern, text):
            group = "value" if "value" in pattern.groupindex else 0
            text = fill(text, match.start(group), match.end(group))
    return text
