"""Words that look like a clause and ask for nothing: idioms, rhetorical questions, and remarks on the present state."""

from __future__ import annotations

import re

from dualbrain.grounding.instruction.clauses.rules.word_classes import PERSON
from dualbrain.grounding.instruction.clauses.scene_words import SceneWords, fill, first_matches

_IDIOMS = re.compile(
    r"\b(?:do|should|must|need|would|will) not (?:hesitate|be (?:shy|afraid|late|lazy|silly"
    r"|alarmed|scared|nervous|surprised)|ask(?: me)?(?: why| how)?"
    r"|wait(?= ?[,;:]| and\b)|wait (?:any longer|for (?:me|us|him|her|anyone|anybody))"
    r"|think twice|dawdle|delay|let me down|get me wrong"
    r"|just (?:stand|sit|wait|lie|hang|stay)(?: around)?(?: there| here)?|panic|overthink(?: it)?|laugh|argue|complain"
    r"|take (?:too long|forever|all day)|waste (?:any |your |my )?time|fail me|disappoint me)\b"
    r"|\byou are (?:simply |really )?the (?:best|greatest|smartest|cleverest|nicest|kindest|fastest)\b"
    r"|\bwhy (?:do|does|did|are|is|would|should|can|could|have|has) not\b"
    r"|\b(?:can|could|would|will) not (?=(?:you|we|somebody|someone|the robot)\b)"
    r"|\bdo not you (?:think|want|agree|believe|see)\b|\bnot (?:tomorrow|later|yesterday) but now\b"
    r"|\byou (?:will|would|can|could|do) not (?:believe|regret|guess|imagine|be disappointed)\b"
    r"|\b(?:is|are|does|do|would|will|can|could|should) not (?:it|you|that|we|there|he|she)(?= ?\?)"
    r"|\b(?:not|never) (?:worry|mind|matter|care) (?:if|when|whether|that) [^.,;:!?]{1,60}|\bwould you not rather\b"
    r"|\buntil (?:now|today|recently)\b|\b(?:either way|in either case)\b"
    r"|\bnot an? (?:\w+ ){0,2}?(?:task|job|problem|deal|request|thing|question|secret|joke)\b"
    r"|\b(?:once more|once again|one more time|again) with feeling\b"
    r"|\bi (?:will |must |have to |can only |am going to )?(?:say|repeat|ask|tell)(?: (?:it|you|this|that|myself))*"
    r"(?: again| once more| once again| one more time)?(?= ?[:,])"
    r"|\blet me (?:say|repeat|ask)(?: (?:it|this|that|myself))*"
    r"(?: again| once more| once again| one more time)?(?= ?[:,])"
    r"|\bi (?:have )?(?:already )?(?:told|asked) you (?:(?:once|twice|thrice|before|already|again)\b"
    r"|(?:\w+ ){1,2}times\b)|\bfor the (?:second|third|fourth|fifth|tenth|hundredth|umpteenth|last|first) time\b"
    r"|\b(?:now or never|more or less|sooner or later|one way or (?:another|the other)|better late than never"
    r"|sooner rather than later|last but not least|never mind|once and for all|(?:like|believe) it or not"
    r"|ready or not|give or take|no ifs (?:, ands )?or buts|on second thought|on the other hand|not to worry"
    r"|on top of (?:that|everything)|next to nothing|behind schedule|between you and me|rain or shine"
    r"|in the middle of (?:something|it all|a (?:call|meeting)|my \w+|cooking|lunch|work)|before i forget"
    r"|before you know it|time and time again i|without (?:any )?further ado|beyond (?:any )?(?:doubt|question)"
    r"|well or badly|right or wrong|most of all"
    r"|(?:once more|once again|one more time) i (?:ask|beg|say|tell)|both (?:of your )?(?:hands|fingers|jaws)"
    r"|no , not (?:that|this|so)(?= ?[,.;:!?]))\b"
    r"|\b(?:been|was|were|am|are|is) (?:\w+ ){0,2}?(?:all day|all night|forever)\b"
    r"|\b(?:has|have|had) been [^,.;:!?]{0,30}?\bfor (?:\w+ ){1,3}?(?:seconds|minutes|hours|days|weeks|months"
    r"|years|ages)\b"
    r"|\b(?:(?:every|each) (?:single )?time|whenever) (?:i|we|he|she|they) (?!say|says|see|tell|notice|hear"
    r"|think|call|feel"
    r"|find|decide|want|need)[^,.;:!?]{1,40}? (?:there (?:is|are)|the (?:\w+ ){1,3}?(?:is|lies|stands|sits))\b"
    r"|\b(?:keep|stay) (?:well )?(?:clear of|away from) (?:the |any |that )?(?:persons?|people|humans?|him|her"
    r"|operator)\b"
    r"|\b(?:is|was) not it (?:about |high )?time\b|\bhow come [^.;!?]{1,60}|\bjust in case(?= ?[,.;:!?]|$)"
    r"|\bin case (?:you|anyone|anybody) (?:have|has|had|did|do|are|is)(?: not)? "
    r"(?:noticed|know|seen|heard|forgotten|wondering|interested)\b"
    r"|\bnot to be (?:\w+ ){1,3}?,? ?(?=but\b)|\bno (?:problem|worries|rush|hurry|matter|big deal) if [^.,;:!?]{1,60}"
    r"|\btake as long as (?:you (?:need|like|want|wish|please)|it takes|necessary)\b"
    r"|\b(?:(?:i|we|it) )?(?:would|will|it'd) (?:really )?(?:be (?:so |very |really |most )?(?:great|nice|glad|happy"
    r"|grateful|good|lovely|helpful|perfect|wonderful|pleased|better|best|delighted|thankful|obliged|kind of you)"
    r"|appreciate it|like it|love it|help)(?: (?:a lot|me))? if (?=(?:you|the|it|we|that|this|my|i)\b)"
)
_REACH = 200
"""Length of the text after a remark in which the request is looked for [characters]."""
_NOT_LEFT = re.compile(
    r"\b(?:can|could|should|must|may|do|does|will|shall|would) not (?:belong|stay|remain|be(?: left)?|lie|stand|sit"
    r"|hang|(?:leave|let|keep) (?:it|that|this|them|the (?:\w+ ){0,2}?\w+))"
    r"(?: (?:around|lying|standing|sitting|left|stay|lie|stand|out))* "
    r"(?:here|there|like (?:that|this)|around(?: here)?|where it is|on the (?:table|floor))\b"
)
_NOT_SO = re.compile(
    r"(?:^|[.,;:!?] |\b(?:because|since|but) )(?P<state>(?:it|this|that|they|the (?:\w+ ){0,2}?\w+) (?:is|are|was) not"
    r"(?: yet| quite| really| currently| even| very| that)?"
    r" (?:(?:in|on|at|where|inside|there|here|far|hard|difficult|heavy|urgent|tidy|pretty|nice|clean|much|complicated"
    r"|dangerous|fragile|hot|sharp|rocket science|well|safe|good)\b"
    r"|(?!to\b|going\b|allowed\b|permitted\b|supposed\b|meant\b|coming\b|touched\b|moved\b)(?:\w+ ){0,2}\w+(?= ?,)))"
)
_REMARK = re.compile(
    r"(?:^|[.;!?] ?)(?P<remark>(?:the|this|that|it|my|our|i|we|everything|nothing|things|people|a|an) [^.,;:!?]{0,60}?)"
    r"(?P<condition>\b(?:unless|if|when|whenever|as long as|while|until|once) [^.,;:!?]{1,80})"
    r"(?= ?(?:, (?:so|therefore|hence|thus|which is why|that is why)\b(?! (?:that|long)\b)|[.;:] ?\w))"
)
_STATE = re.compile(
    r"\b(?:is|are|was|looks?|seems?|feels?|get|gets|becomes?|appears?|makes?|bothers?|annoys?|hate|hates|love|loves"
    r"|dislike|prefer|worry|worries|helps?|am|would be|will be)\b"
)
_REQUEST = re.compile(
    r"\b(?:you|your|want|need|needs|must|should|please|let|put|place|wait|move|bring|take|go|goes|drive|push|pick|grasp"
    r"|hold|lift|drop|set|belongs?|would like|could|can|may|ought|shall|has to|have to|is to|are to)\b"
)
"""Words of a main clause that may itself be the request: then its condition counts."""


_OTHER_SUBJECT = re.compile(
    r"^ ?(?:(?:so|because|since|and|but|well|look|listen) )*(?:(?:i|we) (?:already |only |just )?(?:have|had|am|are|was"
    r"|were|will (?:be|come|leave|return|go)|(?:can|could|do|did) not|told|asked|said|waited|tried|spent|lost)"
    r"|you (?:should have|were|had|took|have been)|(?:he|she|they|it|this|that|there|guests|people|visitors|somebody"
    rf"|someone|everybody|everyone|nobody|dinner|lunch|(?:my|our|the) (?:\w+ )?{PERSON}) (?:already |only "
    rf"|just )?(?:is|are"
    r"|was|were|has|have|had|will|took|takes|comes?|came|arrives?|leaves?|left|said|told|asked|happened|happens"
    r"|starts?))\b"
)
"""The beginning of a remark about the past, the present or another person."""
_SEGMENT = re.compile(r"[^,;:!?.]+")
_DEPENDENCE = re.compile(
    r"\b(?:if|unless|when|whenever|once|until|while|before|after|as soon as|then|by then|afterwards|every time"
    r"|each time)\b"
)
"""Words by which a request depends on the remark beside it."""


def _mask_remarks_on_others(text: str, scene: SceneWords) -> str:
    """`text` with the letter x in place of each clause about the past or about others, beside a request."""
    for match in first_matches(_SEGMENT, text):
        segment = match[0]
        rest = text[: match.start()] + text[match.end() :]
        if (
            (subject := _OTHER_SUBJECT.match(segment))
            and not _REQUEST.search(re.sub(r"\byou\b", "", segment[subject.end() :]))
            and not _DEPENDENCE.search(segment + rest[match.start() : match.start() + _REACH])
            and not scene.mentions(segment, scene.names)
            and _has_request(rest, scene)
        ):
            text = fill(text, match.start(), match.end())
    return text


_MANNER = re.compile(
    r"\b(?:be|go|move|drive|stay|remain) (?:very |extra |more |especially )?(?:careful|gentle|slow|slowly"
    r"|gently|carefully"
    r"|soft|softly|quiet|steady|cautious)\b|\btake care\b|\b(?:keep|stay) (?:well )?(?:clear of|away from)\b"
    r"|\b(?:try|sure|careful|care) not to\b|\b(?:not"
    r"|never) (?:go|move|drive|grip|press|squeeze"
    r"|hold|exceed)\b"
)
_DURING_ACTION = re.compile(
    r"\b(?:when|while) (?:you (?:put|place|carry|move|grip|grasp|lift|drive|push|release|hold)\b"
    r"|(?:you are )?(?:putting|placing|carrying|moving|gripping|grasping|driving|lifting"
    r"|lowering|pushing"
    r"|releasing|setting|holding)\b)"
)
"""The action of the robot itself that a manner belongs to: "when gripping the glass, be gentle"."""


def mask_figures(text: str, scene: SceneWords) -> str:
    """`text` with the letter x in place of words that look like a clause and belong to no request.

    A remark on the present state counts only in front of a request that stands in its own clause.
    """
    has_manner = _MANNER.search(text) is not None
    for match in first_matches(_IDIOMS, text):
        text = fill(text, match.start(), match.end())
    text = _mask_states(text, scene)
    if has_manner:
        for match in first_matches(_DURING_ACTION, text):
            text = fill(text, match.start(), match.end())
    return _mask_remarks_on_others(text, scene)


def _mask_states(text: str, scene: SceneWords) -> str:
    """`text` with the letter x in place of the states that are a reason for the request after them."""
    for match in first_matches(_NOT_LEFT, text):
        if scene.has_destination(_following(text, match)):
            text = fill(text, match.start(), match.end())
    for match in first_matches(_NOT_SO, text):
        if _has_request(_following(text, match), scene):
            text = fill(text, match.start("state"), match.end())
    for match in first_matches(_REMARK, text):
        remark = match["remark"]
        if "you" in match["condition"].split():
            continue
        if _STATE.search(remark) and not _REQUEST.search(remark) and _has_request(_following(text, match), scene):
            text = fill(text, match.start("condition"), match.end())
    return text


def _following(text: str, match: re.Match[str]) -> str:
    """The words after `match` in which a request is looked for."""
    return text[match.end() : match.end() + _REACH]


def _has_request(text: str, scene: SceneWords) -> bool:
    return scene.has_destination(text) or re.search(r"\b(?:put|bring|move|go home|take|drive)\b", text) is not None
