"""Numbers of objects and of repetitions."""

from __future__ import annotations

import re

from dualbrain.grounding.instruction.clauses.rules.clause_rule import ClauseRule
from dualbrain.grounding.instruction.clauses.rules.word_classes import NUMBER, PARAMETER_UNIT, THINGS

COUNTS: tuple[ClauseRule, ...] = (
    ClauseRule(
        "count",
        re.compile(rf"\b(?:twice|thrice|(?:{NUMBER}|several|many|multiple|a few|a couple of|some|as many) times)\b"),
    ),
    ClauseRule(
        "count",
        re.compile(
            rf"\b(?:{NUMBER}|several|half|most|some|a few|a couple|few|couple|many|only one|just one|any two"
            rf"|at most one) of (?:the|them|these|those|my|our|all)\b"
        ),
        re.compile(r"\bmost of it\b|\beach of\b"),
    ),
    ClauseRule(
        "count",
        re.compile(
            rf"\b(?:{NUMBER}|several|a few|a couple of|half a dozen|a dozen|any two|half the"
            rf"|most) (?:of )?(?:more |other |the )?(?:\w+ ){{0,2}}?{THINGS}\b"
        ),
        re.compile(
            rf"\b{NUMBER} things to do\b|\bseveral things on it\b|\bthings (?:for you|i (?:want|need)"
            rf"|on my list|that you could)\b|\bone after the other\b|\bgo to\b"
        ),
    ),
    ClauseRule("count", re.compile(rf"\b{NUMBER} (?:in|on|into|onto|at) (?:the|it)\b")),
    ClauseRule(
        "count",
        re.compile(
            rf"\b(?:exactly|at most|at least|no more than|no fewer than|up to|only|just|not more than|more than"
            rf"|less than|fewer than) (?:{NUMBER})\b(?![.,]\d)(?! (?:{PARAMETER_UNIT})\b)"
        ),
    ),
    ClauseRule(
        "count",
        re.compile(r"\bboth\b"),
        re.compile(
            r"\bboth done\b|\bboth (?:of )?the [^.;!?]{1,50} and (?:the |a )?\w+|\bneed both\b|\bboth hands\b"
            r"|(?:[;,:]|^) ?both (?:go|goes|into|in|belong|should|of them)\b"
        ),
    ),
    ClauseRule(
        "count",
        re.compile(
            r"\b(?:a|one|two) (?:third|quarter|fifth|tenth)s? of (?:the|them|these|those|my|our|all)\b"
            r"|\bthe (?:first|last) (?:two|three|four|five)\b|\bhalf of\b|\bone each\b|\bin pairs\b"
            r"|\ba pair of\b|\bcount (?:to|the|from|down)\b"
        ),
    ),
    ClauseRule("count", re.compile(rf"\b(?:{NUMBER}|several|a few|many) (?:more )?times?\b")),
    ClauseRule("count", re.compile(r"\b(?:exactly|at most|no more than|not more than) (?:one|a single)\b")),
    ClauseRule(
        "count",
        re.compile(
            rf"\b(?:{NUMBER}|several|a few|a couple of|couple of|(?:half )?a dozen|a handful of|another|multiple"
            rf"|many) (?:more |full "
            r"|quick |complete |further )?(?:rounds|laps|trips|cycles|repetitions|reps|iterations|runs|passes"
            r"|goes|tries"
            r"|attempts|circuits|loops|tours|rotations|repeats|lifts|pushes|taps|nudges|shoves)\b"
            r"|\b(?:dozens? (?:of )?times|dozen times|(?:countless|umpteen|numerous) times)\b"
            r"|\b\d{1,3} x\b(?! \d)|\bx \d{1,3}\b(?! (?:mm|cm|m)\b)"
        ),
    ),
)
