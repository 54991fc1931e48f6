"""Places and directions that are defined relative to something, and arrangements."""

from __future__ import annotations

import re

from dualbrain.grounding.instruction.clauses.rules.clause_rule import ClauseRule
from dualbrain.grounding.instruction.clauses.rules.word_classes import AMOUNT, CLOSER_BY_PUSH, LENGTH_UNIT, MOVE

RELATIVE_PLACES: tuple[ClauseRule, ...] = (
    ClauseRule(
        "relative place",
        re.compile(
            r"\b(?:to|on|at|towards|from|by|in) (?:the |its |your |my |their |his |her )?(?:very |far "
            r"|immediate |immediately |direct )?"
            r"(?:left|right)\b(?! (?:now|after|away|above|there|here|behind it))"
        ),
        re.compile(r"\bon the right track\b"),
    ),
    ClauseRule(
        "relative place",
        re.compile(
            r"\b(?:left|right) of (?:the|it|its|my|your|this|that|a)\b|\b(?:left|right) hand side\b|\b(?:just"
            r"|directly|immediately) (?:left|right) of\b"
        ),
    ),
    ClauseRule(
        "relative place",
        re.compile(
            r"\b(?:push|move|slide|shove|nudge|drive|go|turn|rotate|shift|steer|veer|swing|take it|bring it"
            r"|step)(?: (?!to\b|then\b|and\b|right\b|left\b)\w+){0,5}? (?:left|right)\b(?! (?:now|after|away"
            r"|above|there|here|into|in\b|on\b|to\b|over|beside|next|home))"
        ),
    ),
    ClauseRule(
        "relative place",
        re.compile(
            r"\b(?:behind|beneath|underneath|between|in between|among|amongst|next to|in front of|on top of"
            r"|adjacent to|close to|close by"
            r"|on either side|on the (?:other|far|near|opposite) side|on this side|alongside|opposite|beyond"
            r"|across from|diagonally|nearby"
            r"|away from|ahead of|clockwise|counterclockwise|anticlockwise|stack(?:ed|ing)?|in a (?:row|line"
            r"|circle|stack|pile|square|triangle)"
            r"|in the (?:middle|center|corner|vicinity)|at the (?:edge|corner|end|middle|center|back|rear"
            r"|far end)|to the (?:north|south|east|west|side|edge|back|front|rear)"
            r"|on the (?:edge|corner|side|back|front|outside)|in line with|level with|aligned with|parallel to"
            r"|perpendicular to|one on top of|upon each other|on each other"
            r"|halfway|half way|midway|northwards?|southwards?|eastwards?|westwards?|side by side"
            r"|by the side of|in the direction away|as (?:far|close|near) (?:from|to|away)|(?:north|south|east"
            r"|west) of|where (?:the|it|that|my) (?:\w+ ){0,3}(?:was|were|used to be)|(?:right|directly|just"
            r"|immediately) (?:beside|near|under|below|by))\b"
        ),
        re.compile(
            r"\b(?:take|move|get|keep) the arm [^.;!?]{0,20}away from\b|\bclose to (?:done|finished)\b|\bstep away\b"
        ),
    ),
    ClauseRule(
        "relative place",
        re.compile(
            rf"\b{MOVE}\b[^.;!?]{{0,80}}?\b(?:beside|besides|near|under|below|against|outside|past|by the side"
            rf"|around (?:the|it|this|that)|round the|off to)\b"
        ),
        re.compile(
            r"\bneed you beside\b|\bgo home\b|\bunder the (?:\w+ ){1,3}and need\b|\bhandier around\b"
            r"|\bspot under\b|\bin the (?:\w+ ){1,2}near me\b|\bleft outside\b|\ba look around\b|\bcome by\b"
            r"|\bfrom below\b|\bgo by\b|\bunless\b|\bturn around\b"
        ),
    ),
    ClauseRule(
        "relative place",
        re.compile(
            rf"\b(?:{AMOUNT}|a hand|a finger|one) (?:{LENGTH_UNIT}(?:'s)?(?: breadth| width)?|(?:hand"
            rf"|finger)'?s'? (?:breadths?|widths?)) (?:\w+ ){{0,2}}?(?:from|away|left|right|behind|in front"
            rf"|above|below|off|next|before|to the (?:left|right|side)|up|down|upwards?|downwards?|forwards?"
            rf"|backwards?|back|ahead|further|farther|apart|higher|lower|beside|past|beyond|short)\b"
        ),
        re.compile(r"\bhover\b|\bhand above\b"),
    ),
    ClauseRule(
        "relative place",
        re.compile(rf"\b{AMOUNT} {LENGTH_UNIT}\b(?! breadth)"),
        re.compile(r"\bspeed\b|\ba (?:hand|foot)\b|\bno hands?\b"),
        "push distance",
    ),
    ClauseRule(
        "relative place",
        re.compile(
            r"\b(?:forwards?|backwards?|upwards?|downwards?|sideways|inwards|outwards|straight ahead"
            r"|leftwards?|rightwards?|uphill)\b"
        ),
        re.compile(r"\bforward to\b"),
    ),
    ClauseRule(
        "relative place",
        re.compile(
            r"\b(?:push|slide|shove|nudge|pull|drag|move|roll)\b[^.;!?]{0,40}\b(?:away|aside|apart"
            r"|out of the way|together|further|farther)\b"
        ),
        re.compile(
            r"\bmove out of the way , back home\b|\bmove (?:yourself |the arm |your arm )?out of the way\b"
            r"|\btidy\b|\bmove away\b|\bmove the arm away\b|\btowards the\b"
        ),
    ),
    ClauseRule(
        "relative place",
        re.compile(
            r"\btowards (?:you|me|us|him|her|yourself|myself|the (?:person|edge|robot|camera|door|window|wall"
            r"|ceiling|middle|center|left|right|front edge|base|human|operator))\b"
        ),
    ),
    ClauseRule(
        "relative place",
        re.compile(
            r"\b(?:put|set|place|lay|take|bring) (?:it|them|the (?:\w+ ){1,2}?)(?: ?down)? ?back"
            r"(?: again| down| afterwards)?(?= [.,;!?]|$)|\bwhere (?:the|it|that|my) (?:\w+ ){0,3}?(?:is|are"
            r"|stands?|lies)"
            r" (?:now|right now|at the moment)\b|\b(?:swap|exchange|interchange|switch places|trade places)\b"
            r"|\bon (?:each|both|every|all) sides? of\b|\b\w+'s (?:left|right|back|front)\b|\bchange (?:the )?places\b"
        ),
    ),
    ClauseRule(
        "relative place",
        re.compile(r"\b(?:drive|go|roll|move|walk|head)(?: \w+)? ahead\b(?! and\b)"),
    ),
    ClauseRule(
        "relative place",
        re.compile(
            r"\bso that (?:it|they|both) (?:\w+ )?(?:touch\w*|leans?|aligns?|is (?:in line|touching|covered|hidden)"
            r"|covers?|blocks?|overlaps?|forms?|hides?|hangs?|sticks?)\b"
            r"|\b(?:lean|prop|stand|rest)\b[^.,;:!?]{0,60}\bagainst\b"
        ),
    ),
    ClauseRule(
        "relative place",
        re.compile(
            r"(?<!, )(?<!is )(?<!stay )(?<!you )\bwhere(?:ver)? (?:you|i|we|he|she|they|it|there|nobody|no one"
            r"|somebody|someone)"
            r" (?!(?:are|started|start|began|begin|stand|rest|wait|park|were|stop|came from|belongs?|goes|is|was)\b)\w+"
            r"|(?<!, )(?<!is )\bwhere(?:ver)? (?:it|they) (?:came from|comes? from)\b|\bwherever (?:it|there"
            r"|you|they)\b"
            r"|\b(?:its|their) (?:original|previous|former|old|initial|usual|proper|rightful|last|own|first) "
            r"(?:place|spot|position|location|pose)\b"
            r"|\bthe (?:same |very )?(?:place|spot|position|location) (?:that |which |from which |where )?"
            r"(?:you|i|we|he|she|it|they) (?!(?:started|began|are)\b)\w+"
        ),
    ),
    ClauseRule(
        "relative place",
        re.compile(
            r"\b(?:in|into|as|to|to form|make|build|form|create|assemble|construct) an? (?:\w+ )?(?:heap|pile"
            r"|stack|tower"
            r"|row|line|column|circle|ring|pyramid|triangle|square|rectangle|pattern|grid|cluster|arc|wall|bridge|cross"
            r"|formation)\b|\b(?:pile|stack|heap) (?:up|the|them|all|it|these|those|both)\b"
            r"|\b(?:evenly|equidistant|equally spaced|spaced|spread (?:out|them|the|all)|scatter)\b"
            r"|\b(?:put|place|bring|set|gather)\b[^.,;:!?]{0,60}? together\b(?! (?:in|into|on|onto|at|to)\b)"
            r"|\bwith the (?:others?|rest)\b(?! of\b)|\balign(?:ed|ing)?\b|\barm's length\b|\bin the shadow of\b"
            r"|\b(?:put|place|set|move|drop|lay|bring|push)\b[^.,;:!?]{0,60}? where (?:the|my"
            r"|that) (?:\w+ ){1,3}?(?:is|are"
            r"|stands?|lies|sits)\b|\batop\b|\b(?:the way|as) (?:it|they|everything"
            r"|things) (?:was|were|used to be)\b"
            r"|\bmirror (?:the|it)\b|\bwithin (?:\w+ )?reach\b|\bon the far end\b|\bleave (?:a|some) (?:gap"
            r"|space|room)\b"
            r"|\bcover (?:it|them|the (?:\w+ ){1,3}?)(?: ?up)? ?(?:with|by)\b"
            r"|\b(?:bit|little|touch|tad|slightly) (?:(?:to the|more|further|over to the) )?(?:left|right)\b"
            rf"|\b{AMOUNT} (?:hand|finger|thumb|palm)(?:'s|s)? ?(?:breadths?|widths?)\b"
        ),
        re.compile(r"\bhand ?(?:'s|s)? breadth closer\b"),
    ),
    ClauseRule(
        "relative place",
        re.compile(r"\b(?:closer|nearer) to\b"),
        re.compile(CLOSER_BY_PUSH + r"|\bcloser to (?:done|finished|home)\b"),
    ),
)
