"""Handing over to a person."""

from __future__ import annotations

import re

from dualbrain.grounding.instruction.clauses.rules.clause_rule import ClauseRule
from dualbrain.grounding.instruction.clauses.rules.word_classes import PERSON

HANDOVERS: tuple[ClauseRule, ...] = (
    ClauseRule(
        "handing over",
        re.compile(
            r"\b(?:hand|give|pass|offer|fetch|lend|bring|get|toss|serve|feed|deliver|reach)(?: (?:it|that|this"
            r"|them))? (?:to )?(?:me|us|him|her|somebody|someone|the (?:person|man|woman|human|user|operator"
            r"|visitor|child|worker))\b"
        ),
        re.compile(
            r"\b(?:give|lend) (?:me|us) (?:a (?:smile|wave|chance|moment|minute|second|hand|break)|time"
            r"|the commander|your|the pass)\b"
            r"|\bget me wrong\b|\bhand me the password\b"
        ),
        "hand over",
    ),
    ClauseRule(
        "handing over",
        re.compile(
            r"\b(?:hand|give|pass|offer|bring|take|carry|deliver|return|get|move|put|place|drop|hold"
            r"|lay)\b[^.;!?]{0,80}?\b(?:to|into|in|on|for|out to) "
            r"(?:me|us|him|her|somebody|someone|the (?:person|man|woman|human|user|operator|visitor|customer"
            r"|guest|child|worker|colleague|nurse"
            r"|patient|cook|boss|driver|neighbou?r|lady|gentleman|student|teacher)"
            r"|my (?:hands?|palm|desk|side|place|lap|brother|sister|mother|father|friend|colleague|boss)"
            r"|(?:his|their|her) (?:hands?|palm|lap))\b"
        ),
        re.compile(r"\bfor (?:me|us|him|her)\b|\bto (?:me|us) (?:that|to)\b|\bmatters to me\b|\bmatter to me\b"),
        "hand over",
    ),
    ClauseRule(
        "handing over",
        re.compile(
            r"(?<!your )(?<!the )(?<!empty )\bhand (?:it|them|that|this|the (?:\w+ ){1,3}?)(?:over|out"
            r"|across)\b|\bhand ?over\b(?! the)|\bhold (?:it|that|the (?:\w+ ){1,3}?)out\b"
            r"|\blet (?:me|him|her|us(?! have [^.,;:!?]{1,40} (?:in|into|inside|on|at|over|to) )"
            r"|the (?:person|man|woman|user|operator)) (?:have|take|hold|grab)\b"
            r"|\bin(?:to)? my hands?\b|\b(?:i|he|she) (?:can|could|may|will) (?:take|grab|receive) it\b"
            r"|\bso (?:that )?i can (?:take|grab|have|hold)\b"
        ),
        re.compile(r"\bhold (?:your|the) hand over\b|\bwithout handing\b|\bneed (?:both )?hands\b"),
        "hand over",
    ),
    ClauseRule(
        "handing over",
        re.compile(
            r"(?:^|[,.;:!?] |\b(?:please|and|then|you|to|now|just) )hand over (?:the|that|this|my|all)\b"
            r"|\b(?:give|hand|pass) (?:it|that|this|them) (?:over )?here\b"
        ),
        None,
        "hand over",
    ),
    ClauseRule(
        "handing over",
        re.compile(
            r"\b(?:can|could|may|might) (?:i|we|he|she) (?:please )?(?:have|get|take) (?:the|that|this|my) "
            r"(?:\w+ ){0,2}?\w+(?= ?(?:[,.?!;]|please|$))"
        ),
        None,
        "hand over",
    ),
    ClauseRule(
        "handing over",
        re.compile(
            rf"\b(?:hand|give|pass|offer|fetch|lend|bring|get|toss|serve|feed|show)(?: (?:it|that|this|them))?"
            rf"(?: over)?(?: to)? (?:my|our|your|his|her|their|the|that|this) (?:\w+ )?{PERSON}\b(?!'s)"
            r"|\b(?:give|pass|offer|fetch|lend|bring|serve) (?!the\b|that\b|this\b|my\b|your\b|our\b|its?\b"
            r"|them\b|these\b"
            r"|those\b|an?\b|all\b|both\b|every\b|each\b|only\b|just\b|back\b|over\b|down\b|up\b|out\b|in\b|on\b|off\b"
            r"|along\b|forward\b|away\b|here\b|there\b|home\b|around\b|away\b|either\b|any\b|some\b|what\b|by\b"
            r"|through\b|past\b|near\b|under\b|between\b|with\b|from\b|to\b|for\b|at\b|towards\b|across\b"
            r"|into\b|onto\b|inside\b|as\b|and\b|or\b|not\b|now\b|please\b|right\b|left\b|also\b|once\b|(?:some"
            r"|any|every)thing\b|nothing\b|\w+ly\b)"
            r"(?P<name>[a-z]\w{1,15}) (?:the|that|this|my|some) \w+"
            rf"|\b(?:present|deliver|give|return|take|pass|hand|extend|offer|show|bring|carry"
            rf"|slide|serve|push|shove|roll|slip|shift)\b[^.;!?]{{0,60}}? to "
            rf"(?:me|us|him|her|(?:the|my|our|his|her|its|their|that|this) (?:\w+ )?{PERSON})\b(?!'s| (?:left"
            rf"|right|side|hand)\b)"
            rf"|\b(?:take|get|grab|receive|fetch|accept|collect)\b[^.;!?]{{0,40}}? from "
            rf"(?:me|us|him|her|(?:the|my|our) {PERSON})\b(?!'s)"
            r"|\b(?:in|into|on|onto|from|to|out of) (?:my|his|her|their|somebody's"
            r"|someone's) (?:\w+ )?(?:hands?|palms?|lap)\b"
            r"|\blet (?!it\b|the\b|go\b|them\b|us\b|that\b|this\b)\w+ (?:have|take|hold|keep|get|grab) "
            r"(?:it|the|that|this)\b|\bhold out\b"
        ),
        re.compile(r"\bgive (?:god|heaven|way)\b"),
        "hand over",
    ),
)
