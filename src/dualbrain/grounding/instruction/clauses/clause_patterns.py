"""Patterns of clauses that contracts cannot express, over the normal form of `words.normalise`.

A contract is a fixed sequence of skills whose parameters are names in the scene and bounded numbers. It has no
conditions, loops, times, counts or directions. A rule has a `pattern`; a match counts unless the sentence around it
matches `unless`, or the registry has the `capability` that expresses it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

ClauseKind = Literal[
    "condition",
    "loop",
    "time",
    "count",
    "exclusion",
    "relative place",
    "orientation",
    "handing over",
    "alternative",
    "comparison",
]
Capability = Literal["", "wait", "push distance", "hover", "turn", "occupancy", "hand over", "push"]
"""What some registries can express: see `expressible.capabilities`."""

NUMBER = (
    r"(?:\d+(?:[.,]\d+)?|two|three|four|five|six|seven|eight|nine|ten|eleven|twelve|fifteen|twenty|thirty|forty|fifty"
    r"|sixty|ninety|hundred)"
)
AMOUNT = rf"(?:{NUMBER}|an?|one|half an?|a few|several|some|a couple of|a dozen|few|couple of)"
TIME_UNIT = r"(?:s|secs?|seconds?|mins?|minutes?|h|hours?|days?|weeks?)"
LENGTH_UNIT = (
    r"(?:mm|cm|dm|m|millimet(?:er|re)s?|centimet(?:er|re)s?|met(?:er|re)s?|inch(?:es)?|foot|feet|steps?|yards?|hands?"
    r"|fingers?|palms?)"
)
PEOPLE = (
    r"(?:i|we|he|she|they|you|me|us|him|her|somebody|someone|anyone|anybody|everyone|everybody|nobody|no one|people"
    r"|(?:the|a|that|this|my) (?:person|people|man|woman|human|child|kid|user|operator|visitor|worker|colleague|guest"
    r"|customer|sister|brother|mother|father|boss|friend))"
)
THINGS = (
    r"(?:things|objects|items|pieces|ones|blocks|cubes|cans|tins|boxes|cartons|bottles|glasses|parcels|crates|cups"
    r"|mugs|toys|tools|packages|balls|bricks|jars)"
)
MOVE = (
    r"(?:put|place|set|move|drop|lay|stand|push|slide|shove|nudge|shift|leave|bring|park|position|rest|store|stow"
    r"|go|drive|stop|come|hover|hold|point|release|turn|place it|deposit|keep|pull|drag|roll|transfer"
    r"|carry|wait|stay|want|like|should|belongs?)"
)
PUSHES = r"\b(?:push|shove|slide|nudge|pushing|shoving|sliding)\b"
CLOSER_BY_PUSH = (
    r"\b(?:push|shove|slide|nudge)\b.{0,60}\bcloser\b|\bcloser to the\b.{0,60}\b(?:pick|lift)\b"
    r"|\bhand ?(?:'s|s)? breadth closer\b"
)


@dataclass(frozen=True, slots=True)
class ClauseRule:
    """A clause of one `kind`: its `pattern`, the sentences it does not count in, and the capability that expresses it.

    `advice` is what a person can ask for instead, beyond the skills of the robot.
    """

    kind: ClauseKind
    pattern: re.Pattern[str]
    unless: re.Pattern[str] | None = None
    capability: Capability = ""


DONE = re.compile(
    r"\b(?:you|that|this|it|which|one|everything) (?:is |are |has |have )?(?:been )?(?:done|finished)\b"
    r"|\byou (?:have )?(?:put|placed|dropped|moved|brought|finished|stored|been at|been to|delivered|reached|arrive)\b"
    r"|\b(?:it|that|(?:the |this |that )?(?:\w+ ){1,4}?)(?:is|lies|sits|rests|stands|has been|lands|reaches) ?"
    r"(?:put|placed|dropped|moved)? ?(?:in|inside|into|on|at|to) (?:it|there|the)\b"
    r"|\b(?:path|way|route|coast) is (?:free|clear)\b"
    r"|\b(?:\w+ ){1,3}(?:is|lies) (?:in there|there|in|inside)\b"
)
"""The end of an action of the robot itself: an order that a sequence of skills expresses."""
OCCUPANCY = re.compile(
    r"\b(?:free|empty|vacant|full|occupied|taken|available)\b"
    r"|\b(?:nothing|something|anything)(?: else)?(?: is)?(?: already)? (?:in|inside|on)\b"
    r"|\bholds? (?:nothing|something|anything)\b"
)
"""Whether a container holds something, which the planner reads in the scene."""
POLITE_CONDITION = re.compile(
    r"\bif (?:you (?:can|could|please|would|will|like|want|do not mind|are able|have time|are so kind|may)"
    r"|possible|necessary|need be|i may|it is (?:ok|okay|possible|convenient|no trouble|not too much)|it suits"
    r"|that is (?:ok|okay|possible|fine)|you (?:have|find|get) (?:the time|a (?:second|minute|moment|chance))"
    r"|you are not (?:too )?busy|it is not (?:a problem|(?:any|much) trouble)|i (?:might|could) (?:ask|say|suggest))\b"
    r"|\bunless (?:you (?:do )?mind|i am (?:wrong|mistaken)|it is (?:too much|a problem)"
    r"|that is (?:a problem|too much))\b"
    r"|\bif (?:you ask me|i were you|i (?:remember|recall)|i am (?:not mistaken|honest)|memory serves|anything)\b"
    r"|\b(?:when|once|as soon as|whenever) (?:you (?:can|could|like|wish|please|are ready|(?:get|find)"
    r" (?:the time|a (?:chance|minute|second|moment))|have (?:time"
    r"|a (?:moment|minute)))"
    r"|possible|convenient|it suits)\b"
)
ELLIPTIC_CONDITION = re.compile(r"^(?:if (?:not|so|it is not|something is|that is)|otherwise|else)\b")
ROBOT_VERB = (
    r"(?:go|return|bring|put|place|move|drive|carry|take|push|start|do|drop|pick|grasp|come|leave|rest"
    r"|retract|grab|lift"
    r"|head|continue|turn|release|begin)"
)
ROBOT_ACTION = re.compile(
    rf"\byou (?:\w+ ){{0,2}}?{ROBOT_VERB}\b|\bwe start\b"
    r"|\bthe (?:\w+ ){1,5}?(?:goes|is put|is placed|is moved|comes the|is brought|belongs|is carried|must go|can go)\b"
    r"|^(?:before|after)(?: (?:that|this|it|which|all|anything else|everything else))?$"
    r"|^(?:before|after) (?:going|putting|placing|moving|bringing|driving|returning|carrying|picking|grasping|dropping"
    r"|pushing|taking|retracting|visiting|doing|releasing|you are (?:done|finished))\b|^before they come\b"
    r"|^(?:before|after) (?:that|this|which) (?:the|to|you|put|bring|go|drive|move|take|place|carry|return|drop)\b"
    r"|^(?:before|after) (?:the )?(?:\w+ ){0,2}\w+$"
)
"""An action of the robot itself beside "before" or "after"; the last form is a name alone ("after the shelf")."""
OTHERS = re.compile(
    r"\b(?:i|he|she|they|him|her|somebody|someone|anyone|anybody|everyone|everybody|nobody|no one|people|person|man"
    r"|woman|human|child|kids?|user|operator|visitor|worker|colleague|guests?|customer|sister|brother|mother|father"
    r"|boss|friend|my|light|lamp|bell|timer|alarm|phone|clock|door|signal|music|dinner|lunch|breakfast|meeting|coffee"
    r"|work|noon|midnight|sunset|sunrise|dark|rain|oven|kettle|water)\b"
)
"""Somebody or something that the robot does not control."""
WAIT_FOR_WORD = re.compile(r"\b(?:hold|keep|stay|wait|leave|rest|hover|stop|lift|remain|stand|pick|grasp|take|grab)\b")
NEXT_WORD = re.compile(
    r"^until (?:i|we|you are|somebody|someone|further|told|the next)(?: (?:tell|told|say|ask|asks|asked|need|needs|want"
    r"|give|says|tells))?\b.{0,60}?(?:tell you|say|ask|told|need|further|next (?:instruction|command|order))"
)
BY_CONSTRUCTION = re.compile(
    r"\b(?:do|does|must|should|need|have|may|shall|will|can|please|but|and) not "
    r"(?:hurry|worry|rush|mind|know|remember|bother|matter|need|have to|break|damage|drop|knock|crush|scratch|harm|hurt"
    r"|bump|hit|collide|disturb|forget|be (?:too )?(?:fast|slow|rough|hasty)|yet know|squeeze (?:it )?too)\b"
    r"|\b(?:i|we|they) (?:do|did|can|could|would|will|am|are|have) not\b|\bif not\b|\bor not\b|\bwhy not\b"
    r"|\bnot (?:a single|the only|too|so|very|be a single|be any|that it matters|yet know|only)\b"
    r"|\bit is not , then\b|\bnot have to\b"
)
"""Negations that every contract observes, or that ask for nothing."""
UNTOUCHED = re.compile(r"\bnot (?:touch|grasp|pick|lift|take|grab|move|raise|hold)\b")
UNLIFTED = re.compile(r"\bnot (?:lift|pick|grasp|raise|grab|hold)\b")
KEPT = re.compile(
    r"\bnot (?:put|set|lay|place) (?:it|them|that) (?:down|anywhere|back)\b|\bnot (?:let (?:it )?go"
    r"|let go|drop|release)\b|\bnot put the (?:\w+ ){1,3}down\b"
)
LOOKING = re.compile(r"\b(?:look|hover|above|over|point|approach|check|stay above|find)\b")
LIFTING = re.compile(r"\b(?:pick|take|grasp|lift|grab|off the table|hold|raise|keep|grip)\b")
PUSHING = re.compile(rf"{PUSHES}|\bcloser\b|\btowards\b")
STANDING = re.compile(rf"\bnot (?:move|drive|go)(?: for (?:\w+ )?{NUMBER}| any (?:further|farther|more))?\b")
ORDERED = re.compile(r"\bnot (?:\w+ ){1,8}(?:before|until) (?:you have|the|it)\b|\bbut not until\b|\bonly when it\b")

CONDITION_WORD = re.compile(
    r"\b(?:if|unless|in case|in the event|provided|providing|assuming|supposing|as long as|so long as|on condition"
    r"|depending on|only when|otherwise|else|when|as soon as"
    r"|the (?:moment|minute|second|instant) (?:the|i|you|he|she|they|we|it|that|someone|somebody|there|my|his|her|a)"
    r"|once (?:i|you|he|she|they|we|it|that|this|the|somebody|someone|everyone|everybody|nobody|there|all|both"
    r"|everything|my|his|her|a|an)|should (?:the|any|there|it|he|she|they|somebody|someone|anyone"
    r"|anybody|people|everyone|i) (?:\w+ ){0,3}?(?:be|have|come"
    r"|get|move|see|want|need|say|fall|stand|arrive|reach|touch|enter|appear|leave|ask|ring|start|happen|approach"
    r"|nod|wave|shout|call|object|slip))\b"
)
QUESTION_THEN = re.compile(
    r"\b(?:is|are|has|have|does|did|do|can) [^.?!;]{1,60} \? (?:then|only then|if so|if not|if yes|in that case)\b"
)
"""A condition as a question and a sentence that answers it."""
NOT_A_CONDITION = re.compile(
    r"\b(?:something|anything|nothing|everything|somebody|someone|anyone|nobody|whatever|what|who|where) else\b"
    r"|\bor else\b$|\belse on the table\b|\bwhatever else\b"
)
BEFORE_AFTER = re.compile(r"\b(?:before|after)\b")
UNTIL = re.compile(r"\buntil\b")
TURN_UNTIL = re.compile(r"\b(?:turn|rotate|spin)\b.{0,20}\buntil you (?:face|are at|point|look)\b")
NOT = re.compile(r"\bnot\b|\bnever\b")
WITHOUT = re.compile(r"\bwithout\b")
ALLOWED_WITHOUT = re.compile(
    r"^without (?:touching|bumping|knocking|hitting|breaking|dropping|damaging|disturbing|colliding|hurting|scratching"
    r"|crushing|disrupting|harming|spilling|moving) (?:into |with |over |down )?"
    r"(?:it|anything|anyone|anybody|something|anything else|any other|the others|others|the other|people)\b"
    r"|^without (?:haste|hurry|rush|rushing|hurrying|delay|any|problems?|dropping|damage|breaking|contact)\b"
)
WITHOUT_LIFTING = re.compile(r"^without (?:lifting|grasping|picking|raising|gripping|grabbing)\b")
WITHOUT_TOUCHING = re.compile(r"^without (?:touching|grasping|picking|gripping|grabbing|contact)\b")
OR = re.compile(r"\bor\b")
ALLOWED_OR = re.compile(r"^or (?:if that|so|not|what|whatever|something like|similar|better)\b")
EITHER = re.compile(r"\beither\b|\bwhichever\b|\bone or the other\b")
WHETHER = re.compile(r"\bwhether\b")

RULES: tuple[ClauseRule, ...] = (
    # loops
    ClauseRule(
        "loop",
        re.compile(r"\bwhile\b(?! you are at it)"),
        re.compile(
            r"\b(?:a|once in a|little|worth) while\b|\bwhile you are at it\b|\bcareful(?:ly)? while (?:moving"
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
            r"|all day|all night|as often as|do (?:it|this|that) again|and again|again until)\b"
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
    # times
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
            r"|saturday|sunday|morning)|this (?:evening|afternoon)|later today|at the same time|simultaneously"
            r"|meanwhile"
            r"|in the meantime|at the end of the day|on (?:the count of|my (?:command|signal|mark)|a signal)"
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
    # counts
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
            rf"|less than|fewer than) (?:{NUMBER})\b"
        ),
    ),
    ClauseRule(
        "count",
        re.compile(r"\bboth\b"),
        re.compile(
            r"\bboth done\b|\bboth (?:of )?the [^.;!?]{1,50} and (?:the |a )?\w+|\bneed both\b|\bboth hands\b"
            r"|(?:[;,]|^) ?both (?:go|goes|into|in|belong|should|of them)\b"
        ),
    ),
    ClauseRule(
        "count",
        re.compile(
            r"\bthe (?:first|last) (?:two|three|four|five)\b|\bhalf of\b|\bone each\b|\bin pairs\b"
            r"|\ba pair of\b|\bcount (?:to|the|from|down)\b"
        ),
    ),
    # relative places
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
    # orientation
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
    # handing over
    ClauseRule(
        "handing over",
        re.compile(
            r"\b(?:hand|give|pass|offer|fetch|lend|bring|get|toss|serve|feed|deliver)(?: (?:it|that|this"
            r"|them))? (?:to )?(?:me|us|him|her|somebody|someone|the (?:person|man|woman|human|user|operator"
            r"|visitor|child|worker))\b"
        ),
        re.compile(
            r"\bgive me (?:a (?:moment|minute|second|hand|break)|time|the commander|your|the pass)\b"
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
            r"|\blet (?:me|him|her|us|the (?:person|man|woman|user|operator)) (?:have|take|hold|grab)\b"
            r"|\bin(?:to)? my hands?\b|\b(?:i|he|she) (?:can|could|may|will) (?:take|grab|receive) it\b"
            r"|\bso (?:that )?i can (?:take|grab|have|hold)\b"
        ),
        re.compile(r"\bhold (?:your|the) hand over\b|\bwithout handing\b|\bneed (?:both )?hands\b"),
        "hand over",
    ),
    # comparisons
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
    # purposes and sequences over an order
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
        "loop",
        re.compile(
            r"\bfor (?:each|every) [^.;!?]{0,80}\b(?:show|lift|hold|back|count|check|if|look|wait|tell|wipe"
            r"|turn|weigh)\b"
            r"|\band so (?:on|forth)\b"
            r"|\btake turns\b|\bfrom side to side\b"
            r"|\ba (?:second|third|fourth|fifth) time\b|\bet cetera\b|\band repeat\b"
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
    ClauseRule("count", re.compile(rf"\b(?:{NUMBER}|several|a few|many) (?:more )?times?\b")),
    ClauseRule(
        "handing over",
        re.compile(
            r"(?:^|[,.;:!?] |\b(?:please|and|then|you|to|now|just) )hand over (?:the|that|this|my|all)\b"
            r"|\b(?:give|hand|pass) (?:it|that|this|them) (?:over )?here\b"
        ),
        None,
        "hand over",
    ),
    ClauseRule("count", re.compile(r"\b(?:exactly|at most|no more than|not more than) (?:one|a single)\b")),
    ClauseRule(
        "relative place",
        re.compile(
            r"\bso that (?:it|they|both) (?:\w+ )?(?:touch\w*|leans?|aligns?|is (?:in line|touching|covered|hidden)"
            r"|covers?|blocks?|overlaps?|forms?|hides?|hangs?|sticks?)\b"
            r"|\b(?:lean|prop|stand|rest)\b[^.,;:!?]{0,60}\bagainst\b"
        ),
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
        "comparison",
        re.compile(
            r"(?<=\bthe )(?!other|another|either|silver|copper|paper|rubber|leather|timber|amber|former|lavender|ginger"
            r"|pewter|plaster|water)\w{3,}er (?:one|object|thing|cube|block|tin|can|box|bottle|glass|carton)s?\b"
            r"|\b(?:is|are|looks?|seems?) (?:the )?(?!honest|modest|earnest)\w{3,}est\b(?: to \w+)?"
            r"|(?<=\bthe )(?:best|worst) (?:one|object|thing|cube|block|tin|can|box|bottle|glass|carton)s?\b"
        ),
    ),
    # exclusions
    ClauseRule(
        "exclusion",
        re.compile(
            r"\b(?:refrain(?:ing)? from|abstain(?:ing)? from|(?:keep|stay) (?:off|out of|away from|clear of)"
            r"|hands off|forbidden|prohibited|off limits)\b"
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
            r"|anything but|nothing but|every(?:one|thing)? but|but for|barring|skip(?:ping)?|omit)\b"
            r"|\b(?:and|but|with) no (?!hurry|rush|haste|problems?|worries|one|reason)\w+"
            r"|\bbut the (?!only\b)(?:\w+ ){1,3}?(?:one|ones)\b|\bno (?:red|blue|green|yellow|orange|purple"
            r"|teal|white|brown|gray|pink|black) ones?\b"
        ),
        re.compile(r"\bwithout (?:any )?exception\b"),
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
)
"""Rules that one pattern decides; the others are in `clauses.py`."""
