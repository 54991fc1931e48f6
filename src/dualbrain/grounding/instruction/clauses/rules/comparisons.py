"""Comparisons of objects, and orders by a property."""

from __future__ import annotations

import re

from dualbrain.grounding.instruction.clauses.rules.clause_rule import ClauseRule
from dualbrain.grounding.instruction.clauses.rules.word_classes import CLOSER_BY_PUSH

COMPARISONS: tuple[ClauseRule, ...] = (
    ClauseRule(
        "comparison",
        re.compile(
            r"\b(?:bigger|larger|smaller|taller|shorter|heavier|wider|narrower|thicker|thinner|nearer|farther"
            r"|longer|older|newer|brighter|darker|fuller|emptier|rounder|flatter|lighter|prettier one"
            r"|closer (?:one|of|cube|block|bottle|can|box|tin|object)|higher|further)\b"
        ),
        re.compile(
            r"\b(?:no|any) (?:longer|further)\b|\bnot [^.;!?]{0,30}(?:any|much) (?:further|longer)\b|" + CLOSER_BY_PUSH
        ),
    ),
    ClauseRule(
        "comparison",
        re.compile(r"\b(?:lower|upper|inner|outer|closer) (?:one|of the|cube|block|bottle|can|box|tin|shelf)\b"),
    ),
    ClauseRule(
        "comparison",
        re.compile(
            r"\b(?:biggest|largest|smallest|tallest|shortest|heaviest|lightest|widest|narrowest|nearest"
            r"|closest|farthest|furthest|highest|lowest|longest|oldest|newest|leftmost|rightmost|topmost"
            r"|outermost|innermost|brightest|darkest|thinnest|thickest|cleanest|fullest|emptiest|frontmost"
            r"|rearmost)\b"
            r"|\b(?:most|least) (?:fragile|stable|expensive|distant|valuable|colou?rful|dangerous|delicate)\b"
        ),
    ),
    ClauseRule(
        "comparison",
        re.compile(
            r"\b(?:the )?same (?:color|size|kind|shape|type|height|place|spot|one)? ?(?:as|that)\b|\bas (?:big"
            r"|large|tall|small|heavy|wide) as\b|\b(?:than) (?:the|it|that|this|any)\b|\bin (?:ascending "
            r"|descending |alphabetical )?order of\b|\bby (?:size|weight|height|color|length|age|name)\b"
            r"|\b(?:arrange|rearrange|line) (?:up )?the\b"
        ),
        re.compile(r"\brather than\b|\bother than\b"),
    ),
    ClauseRule(
        "comparison",
        re.compile(
            r"\bthe other (?:one|cube|block|object|thing|can|tin|box|bottle|carton|two|container|bowl"
            r"|parcel)\b|\bthe (?:second|third|fourth|fifth|middle|next|first) (?:one|cube|block|object|can"
            r"|tin|box|bottle|carton|from)\b|\bsecond (?:from|to) (?:the )?(?:left|right|last)\b"
        ),
    ),
    ClauseRule(
        "comparison",
        re.compile(
            r"\b(?:sort|rank|order|arrange|grade|organi[sz]e|group|line|queue)(?:ed|ing)?\b[^.;!?]{0,60}?"
            r"\b(?:from \w+ to \w+|by (?!the\b)\w+|according to|alphabetically|in \w+ order)\b"
            r"|\balphabetical(?:ly)?\b|\bin (?:the )?(?:reverse|opposite|alphabetical|random|rainbow|increasing"
            r"|decreasing) order\b"
        ),
    ),
    ClauseRule(
        "comparison",
        re.compile(
            r"\b(?:the|its|whichever|whatever|which|that|is|looks?) (?:\w+ )?(?:most|least) "
            r"(?!of\b|you\b|i\b|important\b|urgent\b|part\b|likely\b)\w+\b(?: to\b)?"
            r"|\bsimilar to\b|\bresembl\w+\b|\bthe (?:more|less) \w+ (?:one|of|object|thing|cube|block|tin|can|box"
            r"|bottle|glass|carton)\b|\b(?!other\b|another\b|either\b)\w{3,}er of (?:the (?:two|three)|x{4,}|both|these"
            r"|those"
            r"|them)\b|(?<=\bthe )\w{3,}est (?:one|of|object|thing|item|cube|block|tin|can|box|bottle|glass|carton)s?\b"
        ),
    ),
    ClauseRule(
        "comparison",
        re.compile(
            r"(?<=\bthe )(?!other|another|either|silver|copper|paper|rubber|leather|timber|amber|former|lavender|ginger"
            r"|pewter|plaster|water)\w{3,}er (?:one|object|thing|cube|block|tin|can|box|bottle|glass|carton)s?\b"
            r"|\b(?:is|are|looks?|seems?) (?:the )?(?!honest|modest|earnest)\w{3,}est\b(?: to \w+)?"
            r"|(?<=\bthe )(?:best|worst) (?:one|object|thing|cube|block|tin|can|box|bottle|glass|carton)s?\b"
        ),
    ),
    ClauseRule(
        "comparison",
        re.compile(
            r"\b(?:that|which|who|whichever|you|i|we|he|she) \w+ (?:the )?(?:most|least|best|worst)\b"
            r"(?! (?:of all|likely|important)\b)"
            r"|\b(?:most|least) (?!likely|probably|certainly|definitely|kindly|humbly)\w+ly\b"
            r"|(?<=\bthe )(?!corner|center|order|number|remainder|border|power|cover|layer|owner|member|manner"
            r"|other|another|either"
            r"|water|paper|finger|upper|lower)\w{3,}er of (?:the|them|these|those)\b"
            r"|\bfrom (?:the )?(?:small|large|big|light|heavy|dark|bright|short|tall|low|high|thin|thick|narrow"
            r"|wide)\w* to\b"
            r"|\b(?:that|which|whichever) (?:is|are|looks?|seems?|weighs?|holds?) (?:less|more) \w+"
            r"|\bwith the (?:most|least|fewest|best|worst|\w{3,}est) (?!of\b)\w+"
        ),
        re.compile(r"\b(?:i|we) (?:need|want|like|love|hate|dislike) (?:the )?(?:most|least|best)\b"),
    ),
    ClauseRule(
        "comparison",
        re.compile(
            r"\b(?:than|as|(?<!not )like) (?:you (?:did|do) |i (?:did|do) |we did |in "
            r"|on )?(?:the )?(?:last time|last run"
            r"|before|yesterday|previously|the time before|previous (?:time|run))\b"
            r"|\b(?:half|twice|double|triple|(?:two|three|four|ten) times) (?:as|the|your|its|that)\b"
            r"|\b(?:above|over|beyond|past|faster than|slower than|more than|harder than) (?:the|your|any) (?:\w+ )?"
            r"(?:limits?|maximum|normal|usual)\b|\b(?:than|as) (?:you are )?(?:allowed|permitted)\b"
            r"|\b(?:faster|slower|harder|softer|gentler|quicker|stronger|higher|lower) than (?:before|usual"
            r"|normal|last)\b"
        ),
    ),
)
