"""Loops and repetitions without a number."""

from __future__ import annotations

import re

from dualbrain.grounding.instruction.clauses.clause_patterns import POLITE_CONDITION
from dualbrain.grounding.instruction.clauses.rules.clause_rule import ClauseRule
from dualbrain.grounding.instruction.clauses.rules.word_classes import NUMBER

LOOPS: tuple[ClauseRule, ...] = (
    ClauseRule(
        "loop",
        re.compile(r"\bwhile\b(?! you are at it)"),
        re.compile(
            r"\b(?:a|once in a|little|worth) while\b|\bwhile you are at it\b|\bwhile (?:i am (?:thinking of it"
            r"|at it)|i (?:think of it|remember)|we are at it|you are (?:there|up|here))\b"
            r"|\bwhile being \w+(?= [.,;!?]|$)"
            r"|\bcareful(?:ly)? while (?:moving"
            r"|doing|you|putting|carrying|placing|driving|going)\b"
        ),
    ),
    ClauseRule(
        "loop",
        re.compile(
            r"\b(?:whenever|(?:every|each|any) time|repeat(?:edly|ing|ed)?|again and again|over and over|forever"
            r"|continuously|continually|constantly|permanently|non ?stop|perpetually|endlessly"
            r"|back and forth|to and fro|up and down|round and round|in (?:a )?(?:loops?|circles?|rounds)|patrol"
            r"|alternate(?:ly)?|alternating|on repeat|periodically|regularly|one more time|once more|once again"
            r"|all day|all night|day in(?: ,)? day out|time after time|and so forth|like clockwork|as often as"
            r"|do (?:it|this|that) again|and again|again until)\b"
        ),
        POLITE_CONDITION,
    ),
    ClauseRule(
        "loop",
        re.compile(
            r"\bkeep (?:on )?(?!holding|waiting|standing|resting|staying|going until|still|being)\w+ing\b"
            r"|\b(?:carry|go|keep) on \w+ing\b|\bcontinue (?:to \w+|\w+ing)\b|\bkeep at it\b|\bkeep doing\b"
        ),
        re.compile(r"\bkeep going to the\b"),
    ),
    ClauseRule(
        "loop",
        re.compile(
            rf"\b(?:every|each) (?:other |few |couple of |{NUMBER} )?(?:seconds?|minutes?|hours?|days?|morning|evening"
            r"|night|week|monday|tuesday|wednesday|thursday|friday|saturday|sunday)\b|\b(?:daily|hourly|weekly)\b"
        ),
    ),
    ClauseRule(
        "loop",
        re.compile(
            r"\bfor (?:each|every) [^.;!?]{0,80}\b(?:show|lift|hold|back|count|check|if|look|wait|tell|wipe"
            r"|turn|weigh)\b"
            r"|\band so (?:on|forth)\b"
            r"|\btake turns\b|\bfrom side to side\b"
            r"|\ba (?:second|third|fourth|fifth) time\b|\bet cetera\b|\band repeat\b"
        ),
    ),
)
