"""Orientations of an object, forms of a motion such as shaking, and motions of an object with another one as a tool."""

from __future__ import annotations

import re

from dualbrain.grounding.instruction.clauses.rules.clause_rule import ClauseRule
from dualbrain.grounding.instruction.clauses.rules.word_classes import PUSHES, THING

_TOOL = r"\b(?:use|using|by means of|with the help of)"
_TOOL_MOTIONS = (
    r"(?:push|shove|slide|nudge|hit|knock|tap|poke|move|drag|sweep|roll|tip|prop|press|lever|scoop|pushing|shoving|sliding"
    r"|nudging|hitting|knocking|moving|dragging|sweeping)\b"
)
ORIENTATIONS: tuple[ClauseRule, ...] = (
    ClauseRule(
        "orientation",
        re.compile(
            r"\b(?:upside down|on (?:its|his) (?:side|head|back|end|edge)|face (?:down|up)"
            r"|the other way (?:round|around)"
            r"|inside out|tilted|tilt|flip(?:ped)?|turn(?:ed)? (?:it|the (?:\w+ ){1,3})(?:over|round|around|upside)"
            r"|turn (?:around|round|over)|upright|lying down|lengthwise|at an angle|sideways on|standing up)\b"
        ),
        re.compile(r"\bupright on the\b"),
    ),
    ClauseRule(
        "orientation",
        re.compile(
            r"\b(?:rotate|turn|spin|twist|flip) (?:it|this|that|the (?:\w+ ){1,3}?)"
            r"(?:by|through|around|over|clockwise|upside|on|\d+(?:[.,]\d+)?|ninety|half)\b"
            r"|\b(?:face|facing) (?:towards )?(?:me|him|her|us|the (?:person|man|woman|human|user|operator|camera))\b"
        ),
        re.compile(r"\bturn (?:the robot|the arm|the base|it on)\b"),
    ),
    ClauseRule("orientation", re.compile(r"\b(?:rotated|facing|degrees)\b"), None, "turn"),
    ClauseRule(
        "orientation",
        re.compile(
            r"\b(?:turn|rotate|spin|twist|swivel|tip|tilt) (?:it|this|that|the (?:\w+ ){1,3}?)"
            r"(?: ?(?:so|such) that\b| ?to face\b| ?(?:a (?:bit|little|quarter|half)|slightly)\b)[^.,;:!?]{0,60}"
            r"|\ba (?:quarter|half|full|complete) (?:turn|rotation)\b|\b(?:spin|twist|swivel) (?:it|the \w+)\b"
        ),
        re.compile(r"\bturn (?:the robot|the base|the arm)\b"),
    ),
    ClauseRule(
        "orientation",
        re.compile(
            r"\b(?:its|the|their|with) (?:\w+ ){0,3}?(?:side|end|edge|label|handle|lid|opening|spout|neck|logo|face|tip"
            r"|mouth|cap|corner|base|bottom|picture|writing)s? (?:\w+ )?(?:faces?|facing|points?|pointing|turned"
            r"|looks?|looking|is up|is down|upwards?|downwards?|uppermost|parallel)\b"
        ),
    ),
    ClauseRule(
        "orientation",
        re.compile(
            r"\b(?:dead|perfectly|absolutely|exactly|completely) (?:level|horizontal|vertical|straight up)\b"
            r"|\bkeep (?:it|them|that|this|the (?:\w+ ){1,3}?)(?:level|horizontal|vertical)\b"
        ),
    ),
    ClauseRule(
        "motion",
        re.compile(
            r"(?:^|[,.;:!?] |\b(?:and|then|please|you|to|now|just|with|by|while) )(?:shake|shaking|stir|swirl"
            r"|wiggle|wobble"
            r"|twirl|jiggle|juggle|bounce|wave|rattle|dance|whirl)\b"
            r"|\b(?:give|with) (?:(?!the left\b|the right\b)\w+ ){0,4}?an? (?:\w+ ){0,2}?"
            r"(?:shake|stir|swirl|wiggle|wobble|twirl|jiggle|bounce|rattle|whirl)\b"
            r"|\bzig ?zag\w*\b|\bin an? (?:\w+ ){0,3}?(?:loop|spiral|arc|curve|figure of eight|wave)\b"
            r"|\bwith (?:an? )?(?:\w+ )?(?:round|circular|swirling|wavy|rocking|shaking) (?:movement|motion)s?\b"
        ),
    ),
    ClauseRule(
        "motion",
        re.compile(
            rf"{_TOOL} (?:the|an?|this|that|one of the) (?:\w+ ){{0,2}}?(?:{THING}) (?:to|for) {_TOOL_MOTIONS}"
            rf"|\b(?:{PUSHES}) (?:it|them|the (?:\w+ ){{1,3}}?)[^.,;:!?]{{0,40}}?{_TOOL} (?:the|an?|this|that) "
            rf"(?:\w+ ){{0,2}}?(?:{THING})\b"
        ),
    ),
)
