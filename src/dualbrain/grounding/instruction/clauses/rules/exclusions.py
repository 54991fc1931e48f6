"""Exclusions without the word not."""

from __future__ import annotations

import re

from dualbrain.grounding.instruction.clauses.rules.clause_rule import ClauseRule

EXCLUSIONS: tuple[ClauseRule, ...] = (
    ClauseRule(
        "exclusion",
        re.compile(
            r"\b(?:refrain(?:ing)? from|abstain(?:ing)? from|(?:keep|stay)(?: (?:it|them"
            r"|the (?:\w+ ){0,2}?\w+))? (?:off|out of|away from|clear of)"
            r"|hands off|forbidden|prohibited|off limits|prevent(?:ing)?|(?:under|in) no circumstances|on no account"
            r"|at no (?:point|time)|by no means|in no case|with the exception of|(?:any|every"
            r"|each) (?:\w+ ){1,2}but|steer clear|detour|refuse to"
            r"|(?:somewhere|anywhere|someplace) else|elsewhere)\b"
            r"|\b(?:put|place|take|bring|drop|pick up) nothing\b"
            r"|\b(?:put|place|move|take|bring|drop|grasp|touch|push|pick up|leave) no "
            r"(?!time|more|longer|notice|offen[cs]e|risks?|chances?|mess|further)\w+"
        ),
        re.compile(r"\bout of the way\b|\bkeep (?:yourself )?out of trouble\b"),
    ),
    ClauseRule(
        "exclusion",
        re.compile(
            r"\b(?:except(?:ing)?|excluding|exclude|other than|apart from|aside from|instead of|rather than"
            r"|avoid(?:ing)?|neither|nor|save for|bar the|leaving out|leave out|all but|everything but"
            r"|anything but|nothing but|(?:bar|minus|less) (?:one|two|the)|every(?:one|thing)? but|but for"
            r"|barring|skip(?:ping)?|omit)\b"
            r"|\b(?:and|but|with) no (?!more|less|fewer|longer|hurry|rush|haste|problems?|worries|one|reason)\w+"
            r"|\bbut the (?!only\b)(?:\w+ ){1,3}?(?:one|ones)\b|\bno (?:red|blue|green|yellow|orange|purple"
            r"|teal|white|brown|gray|pink|black) ones?\b"
            r"|\bno (?:lifting|grasping|gripping|pushing|moving|stacking|placing|putting|driving)\b"
        ),
        re.compile(
            r"\bwithout (?:any )?exception\b|\b(?:push|slide|shove|nudge|scoot"
            r"|edge)\b[^.!?]{0,80}\bno (?:lifting|grasping"
            r"|gripping)\b"
        ),
    ),
    ClauseRule(
        "exclusion",
        re.compile(
            r"\bleave (?:the|it|all|my)\b[^.;!?]{0,30}\b(?:alone|out|untouched|in place)\b|\b(?:all|every"
            r"|everything|each)\b[^.!?]{0,80}\bleave (?:the|it|all|my)\b[^.;!?]{0,30}\bwhere (?:it|they) (?:is"
            r"|are)\b"
        ),
        re.compile(r"\bleave (?:it as it is|(?:the rest|all the rest|all else|the others))\b"),
    ),
    ClauseRule(  # refusals of the request itself
        "exclusion",
        re.compile(
            r"\b(?:i|we) (?:do|did|would) not (?:want|need|ask|like|wish|tell)(?: for)? you to\b"
            r"|\b(?:i|we) do not think (?:that )?you should\b"
            r"|\b(?:put|place|move|take|bring|push|grasp|touch|lift|pick up) none of\b"
            r"|\b(?:anywhere|everywhere|somewhere) but\b"
        ),
        re.compile(
            r"\bnot (?:want|need|ask|like|wish|tell)(?: for)? you to "
            r"(?:hurry|rush|worry|break|drop|spill|hurt|hit|bump|tip|topple|get hurt|be late|scratch|damage|crash)\b"
        ),
    ),
)
