"""Patterns of conditions, orders, negations and alternatives, over the normal form of `words.normalise`.

`clause_search.py` judges each match by the words around it. A contract is a fixed sequence of skills whose parameters
are names in the scene and bounded numbers. It has no conditions, loops, times, counts or directions.
"""

from __future__ import annotations

import re

from dualbrain.grounding.instruction.clauses.rules.word_classes import NUMBER, PUSHES

DONE = re.compile(
    r"\b(?:you|that|this|it|which|one|everything) (?:is |are |has |have )?(?:been )?(?:done|finished)\b"
    r"|\byou (?:have )?(?:put|placed|dropped|moved|brought|finished|stored|been at|been to|delivered|reached|arrive)\b"
    r"|\b(?:it|that|(?:the |this |that )?(?:\w+ ){1,4}?)(?:is|lies|sits|rests|stands|has been|lands|reaches) ?"
    r"(?:put|placed|dropped|moved)? ?(?:in|inside|into|on|at|to) (?:it|there|the|n{4,})\b"
    r"|^(?:when|once|as soon as) (?:done|finished)\b|\b(?:path|way|route|coast) is (?:free|clear)\b"
    r"|\b(?:\w+ ){1,3}(?:is|lies|stands|sits) (?:in there|there|in|inside|n{4,})\b"
    r"|\byou (?:have|hold|got|grasped|(?:have |are )(?:got|grasped|lifted|holding|picked up)) (?:it|that|this|them)\b"
)
"""The end of an action of the robot itself: an order that a sequence of skills expresses."""
OCCUPANCY = re.compile(
    r"\b(?:free|empty|vacant|full|occupied|taken|available)\b"
    r"|\b(?:nothing|something|anything)(?: else)?(?: is)?(?: already)? (?:in|inside|on)\b"
    r"|\bholds? (?:nothing|something|anything)\b"
)
"""Whether a container holds something, which the planner reads in the scene."""
FILLED = re.compile(r"\b(?:full|empty)\b")
LATER_STATE = re.compile(r"\b(?:turns? out|proves?|happens? to)\b")
"""A state that comes out while the robot acts."""
_NOT_PERCEIVED = r"(?! (?:\w+ly )?(?:hear|see|feel|sense|detect|find|smell|notice|spot|read|recogni[sz]e|observe)\b)"
"""After "if you can": without a verb of perception, the words are polite."""
_HAVE_TIME = (
    r"(?:have|have got|got|get|find) (?:the |a |some |any )?(?:free |spare |quiet |little )?"
    r"(?:time|chance|opportunity|(?:second|minute|moment|sec|hand)(?= (?:[,.;:!?]|to|free|spare|please|could|can|would"
    r"|will|put|take|move|bring|grasp|go)\b| [,.;:!?]|$))"
)
_CONVENIENT = (
    r"(?:ok|okay|fine|alright|all right|possible|convenient|no (?:trouble|bother|problem|burden)"
    r"|not (?:too much|an? (?:problem|bother|burden)|(?:any|much) (?:trouble|bother)|inconvenient))"
)
POLITE_CONDITION = re.compile(
    rf"\bif (?:you (?:(?:can|could|would|will|want|like|may){_NOT_PERCEIVED}|please|do not mind|are able"
    rf"|are so kind|have nothing (?:else|better|more important)"
    rf"|would not mind|feel like it|are (?:free|available)|{_HAVE_TIME})"
    r"|you'd (?:be so|like|please|care|not)|nothing else|only (?:the|it|that|this|you|i)|possible|necessary"
    r"|need be|i may|(?:it|that) suits"
    rf"|(?:it|that|this) (?:is|would be) {_CONVENIENT}"
    r"|you are not (?:too )?busy|i (?:might|could) (?:ask|say|suggest))\b"
    r"|\bunless (?:you (?:do )?mind|i am (?:wrong|mistaken)|it is (?:too much|a problem)"
    r"|that is (?:a problem|too much))\b"
    r"|\bif (?:you ask me|i were you|i (?:remember|recall)|i am (?:not mistaken|honest)|memory serves|anything)\b"
    rf"|\b(?:when|once|as soon as|whenever) (?:you (?:(?:can|could){_NOT_PERCEIVED}|like|wish|please|{_HAVE_TIME}"
    r"|are (?:ready|free|available|not busy))"
    r"|possible|convenient|ready|it suits)\b"
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
    r"|^after (?:the other|another)\b"
)
"""An action of the robot itself beside "before" or "after"."""
NAME_ALONE = re.compile(r"^(?:before|after) (?P<article>the )?(?:\w+ ){0,2}\w+$")
"""A name beside "before" or "after" ("after the shelf"): an action of the robot if it is a name of the scene."""
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
    r"\b(?:do|does|must|should|need|have|may|shall|will|would|can|please|but|and) not "
    r"(?:hurry|worry|rush|mind|know|remember|bother|matter|need|have to|break|damage|drop|knock|crush|scratch|harm|hurt"
    r"|bump|hit|collide|disturb|forget|squeeze|shake|tip|topple|fall|slip|be (?:too )?(?:fast|slow|rough|hasty)"
    r"|yet know"
    r"|squeeze (?:it )?too)\b"
    r"|\b(?:i|we|they) (?:do|did|can|could|would|will|am|are|have) not\b|\bif not\b|\bor not\b|\bwhy not\b"
    r"|\bi (?:bet|think|guess|doubt) you (?:can|could|will|would) not\b"
    r"|\bnot (?:a single|the only|too|so|very|be a single|be any|that it matters|yet know|only)\b"
    r"|\b(?:try|sure|careful|care|attempt|effort) not to (?:break|damage|drop|knock|crush|scratch|harm|hurt"
    r"|bump|hit|collide"
    r"|disturb|squeeze|shake|tip|topple|slip|touch|spill)\b|\byou (?:have|did) not (?:\w+ ){1,8}?yet\b"
    r"|\bnot let (?:it|them|the (?:\w+ ){1,3}?) ?(?:slip|fall|drop|tip|break|topple)\b|\bit is not , then\b"
    r"|\bnot have to\b|\bi (?:have )?never (?!want|like|allow|let|put)"
    r"|\b(?:can|could) not (?:see|reach|find|get at|read|bend|lift|carry|walk|stand|tell|remember|hear)\b"
    r"|\b(?:not|never) (?:go|move|drive|travel|grip|press|squeeze|hold|exceed|use)(?: it| the \w+)? x{4,}"
)
"""Negations that every contract observes, or that ask for nothing."""
UNTOUCHED = re.compile(r"\bnot (?:touch|grasp|pick|lift|take|grab|move|raise|hold)\b")
UNLIFTED = re.compile(r"\bnot (?:lift|pick|grasp|raise|grab|hold)\b")
KEPT = re.compile(
    r"\bnot (?:put|set|lay|place) (?:it|them|that) (?:down|anywhere|back)\b"
    r"(?! (?:in|into|inside|on|onto|at|next|near|beside|behind|to)\b)|\bnot (?:let (?:it )?go"
    r"|let go|drop|release)\b|\bnot put the (?:\w+ ){1,3}down\b"
)
LOOKING = re.compile(r"\b(?:look|hover|above|over|point|approach|check|stay above|find)\b")
LIFTING = re.compile(r"\b(?:pick|take|grasp|lift|grab|off the table|hold|raise|keep|grip)\b")
PUSHING = re.compile(rf"{PUSHES}|\bcloser\b|\btowards\b")
STANDING = re.compile(rf"\bnot (?:move|drive|go|budge|stir)(?: for (?:\w+ )?{NUMBER}| any (?:further|farther|more))?\b")
ORDERED = re.compile(r"\bnot (?:\w+ ){1,8}(?:before|until) (?:you have|the|it)\b|\bbut not until\b|\bonly when it\b")

CONDITION_WORD = re.compile(
    r"\b(?:if|unless|in case|in the event|provided|providing|assuming|supposing|(?<!i )(?:suppose|imagine)"
    r"|as long as|so long as|on condition"
    r"|depending on|only when|otherwise|else|when|as soon as"
    r"|the (?:moment|minute|second|instant) (?:the|i|you|he|she|they|we|it|that|someone|somebody|there|my|his|her|a)"
    r"|once (?:i|you|he|she|they|we|it|that|this|the|somebody|someone|everyone|everybody|nobody|there|all|both"
    r"|everything|my|his|her|a|an)|should (?:the|any|there|it|he|she|they|somebody|someone|anyone"
    r"|anybody|people|everyone|i) (?:\w+ ){0,3}?(?:be|have|come"
    r"|get|move|see|want|need|say|fall|stand|arrive|reach|touch|enter|appear|leave|ask|ring|start|happen|approach"
    r"|nod|wave|shout|call|object|slip)"
    r"|as the (?:bell|alarm|light|lamp|clock|music|timer|phone|door|signal|buzzer|siren) \w+s"
    r"|should you (?:\w+ ){0,2}?(?:hear|see|feel|notice|find|detect|sense|spot)|given that|(?:check|see"
    r"|find out|test|verify|determine|look) (?:\w+ )?whether|no sooner than"
    r"|in the case (?:of|that)|pending|on the (?:off )?chance|failing (?:that|this|which)"
    r"|subject to|contingent on|conditional on|(?:in|under) (?:that|which) (?:case|condition)"
    r"|with (?:my|his|her|their|our|\w+'s) (?:\w+ )?(?:permission|approval|consent|ok|okay|agreement|blessing)"
    r"|(?:up)?on (?:hearing|seeing|noticing|detecting|sensing|receiving|request|demand|(?:my|his|her|the|a) (?:\w+ )?"
    r"(?:signal|command|whistle|call|cue|nod|request|beep|ring|word|mark))"
    r"|at (?:the|my|his|her) (?:\w+ )?(?:sound|signal|sight|whistle|call|cue|nod|request|beep|ring|first sign"
    r"|command|word|mark|stroke)"
    r"|were (?:the|it|he|she|they|somebody|someone|anyone|there) (?:\w+ ){0,2}?to"
    r"|(?:ask|consult|call|check with|get (?:permission|approval) from) (?:\w+ ){1,3}?(?:first|before|beforehand))\b"
    r"|(?:^|[.;!?] |\b(?:and|but) )should (?:the|any|there|it|he|she|they|somebody|someone|anyone|anybody|people"
    r"|everyone|i|my|this|that) [^,.;:!?]{1,60}(?= ,)"
)
QUESTION_THEN = re.compile(
    r"\b(?:is|are|has|have|does|did|do|can) [^.?!;]{1,60} \? (?:then|only then|if so|if not|if yes|in that case)\b"
)
"""A condition as a question and a sentence that answers it."""
NOT_A_CONDITION = re.compile(
    r"\b(?:something|anything|nothing|everything|somebody|someone|anyone|nobody|whatever|what|who|\w+where) else\b"
    r"|(?<!me )(?<!us )\b(?:know|knows|knew|wonder|wondering|sure|certain|doubt|idea|remember|curious) (?:if|when)\b"
    r"|\bwhat if (?:you|we)\b|\bor else\b$|\bor else (?:i|we|you|he|she|it|there)\b|\belse on the table\b"
    r"|\bwhatever else\b"
)
BEFORE_AFTER = re.compile(r"\b(?:before|after)\b")
UNTIL = re.compile(r"\buntil\b")
TURN_UNTIL = re.compile(r"\b(?:turn|rotate|spin)\b.{0,20}\buntil you (?:face|are at|point|look)\b")
NOT = re.compile(r"\bnot\b|\bnever\b")
WITHOUT = re.compile(r"\bwithout\b")
ALLOWED_WITHOUT = re.compile(
    r"^without (?:touching|bumping|knocking|hitting|breaking|dropping|damaging|disturbing|colliding|hurting|scratching"
    r"|crushing|disrupting|harming|spilling|moving|squeezing|shaking|tipping) (?:into |with |over |down )?"
    r"(?:it|anything|anyone|anybody|something|anything else|any other|the others|others|the other|people)\b"
    r"|^without (?:my|his|her|our|your) (?:reading )?(?:glasses|specs|spectacles|help)\b|^without (?:you|me|fail"
    r"|fuss|noise|a (?:sound|word|scratch|fuss|doubt|problem)|making (?:any )?(?:noise"
    r"|sound|mess)"
    r"|haste|hurry|rush|rushing|hurrying|delay|any|problems?|dropping|damage|breaking|contact)\b"
)
WITHOUT_LIFTING = re.compile(r"^without (?:lifting|grasping|picking|raising|gripping|grabbing)\b")
WITHOUT_TOUCHING = re.compile(r"^without (?:touching|grasping|picking|gripping|grabbing|contact)\b")
OR = re.compile(r"\bor\b")
ALLOWED_OR = re.compile(
    r"^or (?:else (?:i|we|you|he|she|it|there)|(?:i|we) (?:will|am|are|have to|must)|if that|so|not|what"
    r"|whatever|something like|similar|better)\b"
)
EITHER = re.compile(r"\beither\b|\bwhichever\b|\bone or the other\b")
WHETHER = re.compile(r"\bwhether\b")
RETRACTION = re.compile(
    r"\bchanged (?:my|our) minds?\b|\b(?:i|we) (?:am|are|was|were) (?:only |just )?(?:joking|kidding)\b"
    r"|\b(?:it|that|this) (?:is|was) (?:only |just )?a (?:joke|mistake)\b"
    r"|\b(?<!or )(?:i|we) (?:will|would rather) do (?:it|that) (?:myself|ourselves)\b"
    r"|(?<=[.!?;,] )never mind(?: (?:that|it|then))?(?= ?[.!?]*$)|(?<=[.!?] )no(?= ?[.!?]*$)"
    r"|\b(?:he|she|they|boss|mother|father|wife|husband) (?:said|says|say) no\b"
)
"""Words after a request that withdraw it, although they are remarks by their form."""
