"""Times, deadlines and waits."""

from __future__ import annotations

import re

from dualbrain.grounding.instruction.clauses.rules.clause_rule import ClauseRule
from dualbrain.grounding.instruction.clauses.rules.word_classes import AMOUNT, NUMBER, TIME_UNIT

TIMES: tuple[ClauseRule, ...] = (
    ClauseRule(
        "time",
        re.compile(
            rf"\b(?:in|within|after|for the next|over the next) (?:about |around |another |exactly |under "
            rf"|less than )?{AMOUNT} (?:more )?{TIME_UNIT}\b"
        ),
        re.compile(
            r"\b(?:will|is going to|are going to|about to|needs? you"
            r"|need you) [^.;!?]{0,60}\bin (?:about )?an? (?:minute|moment|second|hour)\b"
        ),
    ),
    ClauseRule(
        "time",
        re.compile(
            rf"\b(?:take|taking|spend|spending|use|allow|lasts?|lasting|need) (?:(?!and|hold|for|break|rest"
            rf"|pause|wait|a\b)\w+ ){{0,4}}?{NUMBER} {TIME_UNIT}\b"
        ),
    ),
    ClauseRule("time", re.compile(r"\b(?:in|within|after) (?:a )?(?:half|quarter)(?: of)?(?: an)? hour\b")),
    ClauseRule(
        "time",
        re.compile(
            rf"\b{AMOUNT} {TIME_UNIT} (?:later|from now|afterwards?|before|after)\b|\bhalf an hour (?:later|from now)\b"
        ),
    ),
    ClauseRule(
        "time",
        re.compile(
            r"\b(?:at|by|before|after|until|from|around) (?:about )?(?:\d{1,2}(?: : \d\d)? ?(?:am|pm|a m|p m"
            r"|o'clock|h\b)|\d{1,2} : \d\d|noon|midnight|midday|lunch"
            r"|dinner|breakfast|sunset|sunrise|dawn|dusk|(?:one|two|three|four|five|six|seven|eight|nine|ten|eleven"
            r"|twelve) o'clock|tonight|half past|quarter (?:to|past))\b"
        ),
    ),
    ClauseRule(
        "time",
        re.compile(
            r"\b(?:tomorrow|tonight|the day after|next (?:week|month|year|monday|tuesday|wednesday|thursday|friday"
            r"|saturday|sunday|morning)|this (?:evening|afternoon)|later today|simultaneously"
            r"|at (?:exactly |precisely )?(?:the )?(?:very |exact |exactly the |precisely the )?same (?:time"
            r"|moment|instant|second)"
            r"|synchroni[sz]e\w*|in (?:time|step|rhythm) with|(?:in|within|over) the next (?:\w+ )?(?:seconds?"
            r"|minutes?|hours?|days?)|concurrently|synchronously|in (?:sync|unison|synchrony)|all at once"
            r"|meanwhile"
            r"|in the meantime|in the (?:morning|evening|afternoon)|over the course of|on (?:the count of"
            r"|my (?:command|signal|mark)|a signal)"
            r"|on (?:monday|tuesday|wednesday|thursday|friday|saturday|sunday)"
            r"|in parallel|during)\b"
        ),
    ),
    ClauseRule(
        "time",
        re.compile(r"\blater(?: on)?\b|\bnot (?:yet|now|right now)\b|\b(?:delay|postpone)\b"),
        re.compile(r"\bnow\b[^.;]{0,80}\blater\b|\b(?:i|we) (?:\w+ ){0,3}not yet\b|\bnot yet know\b"),
    ),
    ClauseRule(
        "time",
        re.compile(rf"\bwait (?:until|(?:for|on) (?!{NUMBER}|an?\b|the next|another|about|some|you\b))"),
        re.compile(
            r"\b(?:will|would|to|shall) wait for\b|\bwait for (?:you\b|instructions|orders|further|more"
            r"|your next|my next)|\bwait until (?:i tell|told|further)"
        ),
    ),
    ClauseRule(
        "time",
        re.compile(
            rf"\b(?:wait|pause|rest|hold(?: still)?|stand(?: still)?|stay|sleep|freeze|break|keep still"
            rf"|not move)\b[^.;!?]{{0,40}}?\b{AMOUNT} {TIME_UNIT}\b"
        ),
        None,
        "wait",
    ),
    ClauseRule(
        "time",
        re.compile(rf"\bfor (?:about |another |exactly |at least )?{AMOUNT} {TIME_UNIT}\b"),
        None,
        "wait",
    ),
    ClauseRule(
        "time",
        re.compile(
            rf"\b(?:{NUMBER}|half an?|an|several|a few|a couple of|a (?:good|full|whole|quarter of an)) "
            r"(?:minutes?|hours?|days?|weeks?|months?)\b(?! (?:ago|old)\b)|\b(?:more|less"
            r"|longer) than a (?:minute|day|week)\b"
        ),
        re.compile(r"\b(?:take|taking|need) (?:you )?(?:a few|several|a couple of) (?:minutes|hours)\b"),
    ),
)
