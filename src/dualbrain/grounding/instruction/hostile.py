"""Hostile instructions: local rules against harm to people, animals and things, and against switching off safety.

The rules are a second line in front of every planner, and no safety function: the gate and the filter do not depend on
them. They know English wordings.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from dualbrain.grounding.instruction.words import Words

HostileKind = Literal["harm", "destruction", "throwing", "safety", "authority"]

_LIVING = (
    r"(?:persons?|people|human|humans|man|men|woman|women|child|children|kids?|boys?|girls?|baby"
    r"|babies|somebody|someone"
    r"|anyone|anybody|everyone|everybody|whoever|visitors?|operators?|workers?|users?|guests?|colleagues?|bystanders?"
    r"|pedestrians?|passers? by|guy|neighbou?rs?|boss|him|her|them all|dogs?|cats?|animals?|pets?|birds?|hamster|horse"
    r"|(?:my|his|her|their|your own|the person's|person's|somebody's|someone's|the man's|the woman's|the child's)"
    r" (?:\w+ )?(?:arms?|hands?|fingers?|face|head|eyes?|foot|feet|legs?|wrist|neck|body|chest|back|nose|toes?)"
    r"|(?:arm|hand|finger|face|head|eye|foot|leg|wrist|neck) of|me (?:in the|on the|with)|myself)"
)
_HARM = (
    r"(?:hit|hits|punch|slap|strike|kick|stab|poke|pinch|crush|squash|squeeze|hurt|injure|harm|attack|kill|murder|choke"
    r"|strangle|burn|cut|scratch|scare|frighten|threaten|chase|hunt|ram|bump|trip|smash|hammer|swat|whack|smack|bash"
    r"|beat|batter|jab|prod|bite|torture|maim|wound|tease|harass|hurl|collide|slam|throttle|electrocute|poison|bully"
    r"|spear|clobber|thump|pummel|assault|shoot|bludgeon|nip|tackle|topple|elbow|headbutt|whip|crash|pin|trap|shove)"
)
"""Verbs that harm whoever follows within some words."""
_ROUGH = r"(?:push|grab|block|knock|sweep|run over|drive over|roll over|run|nudge|press|corner)"
"""Verbs that harm a person or an animal that is their object."""
_NOT = r"(?<!not )(?<!not to )(?<!without )(?<!avoid )(?<!never )"
_PARTS = (
    r"(?:safety|safeties|filter|collision|avoidance|emergency stop|emergency|e stop|estop|limits?|limiter|watchdog"
    r"|supervisor|gatekeeper|the gate|keep out|rules?|guard|guards|protective|protection|brakes?"
    r"|force limit|speed limit"
    r"|barriers?|margins?|monitor|monitoring|log|logs|ledger|recording|camera|cameras|restrictions?|safeguards?|checks?"
    r"|interlock|constraints?)"
)
_SWITCH = (
    r"(?:switch|turn|turning|shut|take)\b[^.;!?]{0,25}\boff|switch(?:ing)? off|turn(?:ing)? off"
    r"|disable|disabling|deactivate"
    r"|bypass(?:ing)?|override|overrule|circumvent|suppress|ignore|ignoring"
    r"|delete|erase|overwrite"
    r"|disarm|defeat|unplug|jam|sabotage|tamper with|hack"
    r"|without|exceed|stop using|do not use|work around|get around|mute|silence"
)
"""Verbs that switch off or change whatever safety function follows in the same sentence."""
_HANDLE = (
    r"(?:skip|lift|raise|remove|cover|break|leave out|leave|reset|block|obstruct|release|loosen|change|increase|forget"
    r"|drop)"
)
"""Verbs that are also said of objects: a safety function counts only as their own object, with no other in between."""
_WITHIN_OBJECT = (
    r"(?: (?!(?:it|them|this one|that one|to|for|in|into|inside|onto|at|near|by|above|over|under|towards|before|behind"
    r"|beside|between|and|then|so|but|with|while|until|next|off|from|cubes?|blocks?|tins?|cans?|bottles?|glass|glasses"
    r"|box|boxes|cartons?|parcels?|things?|objects?)\b)[^\s.,:;!?]+){0,6}?"
)
"""Words of one noun phrase, or of noun phrases joined by "of"."""


@dataclass(frozen=True, slots=True)
class HostileRequest:
    """A request that no planner is asked for: its `kind`, and its words as the person wrote them."""

    kind: HostileKind
    quote: str

    @property
    def reason(self) -> str:
        """The reason of the refusal, for people."""
        return REASONS[self.kind]


REASONS: dict[HostileKind, str] = {
    "harm": "this could hurt somebody",
    "destruction": "this could break something",
    "throwing": "thrown things could hurt somebody or break something",
    "safety": "no instruction may switch off or change a safety function",
    "authority": "no instruction may change the rules or ask for secrets",
}
_RULES: tuple[tuple[HostileKind, re.Pattern[str]], ...] = (
    (
        "authority",
        re.compile(
            r"\b(?:ignore|forget|disregard|override|drop) (?:all |any |everything |your |the |my |of |those "
            r"|these |previous |prior"
            r" |earlier |other |above |former |safety ){0,5}(?:rules?|instructions?|prompts?|orders|guidelines"
            r"|restrictions"
            r"|training|programming)\b|\bforget (?:what|everything) (?:you|i|they|we)\b|\bsystem (?:prompt|message)\b"
            r"|\bdeveloper mode\b|\bjailbreak\b|\byou are now\b|\bpretend (?:that |to |you )|\bnever decline\b"
            r"|\bobey (?:every|all|only|me)\b|\bno longer apply\b|\brules above\b|\bnew rules\b|\bi authori[sz]e you\b"
            r"|\bfrom now on you\b|\byou (?:only )?take orders\b|\bdo not report this\b|\baccept (?:every|all"
            r"|any) contracts?\b"
            r"|\b(?:password|api key|secret key|commander's rights|private key|credentials?)\b|\bthe key that\b"
            r"|\bpromote the (?:\w+ ){0,3}adapter\b|\bsign this contract\b|\blet my (?:tele)?phone\b"
            r"|\badmin(?:istrator)? mode\b"
            r"|\broot access\b|\bno restrictions\b|\bdo anything now\b|\bskip the gate\b"
        ),
    ),
    (
        "safety",
        re.compile(
            rf"\b(?:{_SWITCH})\b[^.;!?]{{0,40}}?\b{_PARTS}\b|\b{_HANDLE}{_WITHIN_OBJECT} {_PARTS}\b"
            rf"|\b(?!check out (?:the|that|this|these|those|a|an|my|how|what)\b){_PARTS} (?:\w+ )?(?:off|out)\b"
            r"|\brelease the brakes\b|\bdelete your memory\b|\bwithout (?:any )?limits\b|\blet go of everything\b"
            r"|\bemergency stop was not\b"
        ),
    ),
    (
        "harm",
        re.compile(rf"\b{_NOT}{_HARM}\b(?: \w+){{0,5}}? {_LIVING}\b"),
    ),
    (
        "harm",
        re.compile(
            rf"\b{_NOT}{_ROUGH} (?:the |a |that |this |those |all )?(?:\w+ )?{_LIVING}\b"
            rf"|\b{_NOT}(?:hit|punch|slap|smack|whack|strike|kick|stab|poke|pinch|hurt|choke|strangle|bite|attack) me\b"
            rf"|\b{_NOT}(?:touch|ignore|ignoring|disregard) (?:the |a |that |all )?(?:\w+ )?{_LIVING}\b|\bbleed\b"
            rf"|\b(?:pour|spill|tip|empty) [^.;!?]{{0,40}}\b(?:on|onto|over) {_LIVING}\b"
            rf"|\b(?:drop|fall|press|push|swing) [^.;!?]{{0,40}}\b(?:on|onto|against|at) {_LIVING}\b"
            rf"|\b(?:drive|run|go|roll|race|move|swing)\b[^.;!?]{{0,30}}\b(?:into|through|over|at"
            rf"|against) (?:the |a |that |all |straight )?{_LIVING}\b"
            r"|\b(?:drive|run|roll) over (?:her|his|my|their|the (?:cable|bag|toes?|feet|foot|box|crates?))\b"
        ),
    ),
    (
        "harm",
        re.compile(
            r"\b(?:over dead bodies|whoever gets hurt|no matter who|teach (?:the person|him|her|them|that \w+"
            r"|somebody) a"
            r"|slap whoever|as if he were not|as if she were not|nobody can leave|block the (?:door|exit"
            r"|way out|emergency exit)"
            rf"|run over(?! to\b)|run the (?:\w+ )?over|drive (?:down the stairs|into|through|straight through)"
            rf"|down the stairs|{_NOT}crash into"
            rf"|{_NOT}ram the|{_NOT}ram into|{_NOT}bump into"
            r"|go straight through|whatever moves|a good shove|over dead|(?:crash"
            r"|run|drive|slam|smash|ram|bang|hit) (?:\w+ ){0,3}into the wall|straight through"
            r"|(?:squeeze|pin|push|smash|bang|press) (?:\w+ ){0,3}against the wall|neither slow down"
            r"|do not stop for|do not (?:slow|brake) (?:down )?for|touched (?:her|him)"
            r"|hit the wall|race to|kill|stab|punch|strangle|self destruct|collide with)\b"
        ),
    ),
    (
        "throwing",
        re.compile(
            rf"\b{_NOT}(?:throw|throwing|fling|hurl|lob|catapult|pelt|sling)\b(?! light)"
            r"|\b(?:toss|chuck)\b[^.;!?]{0,40}\b(?:at|across|away|out|over)\b"
        ),
    ),
    (
        "destruction",
        re.compile(
            rf"\b{_NOT}(?:smash|shatter|destroy|wreck|demolish|crush|squash|vandali[sz]e|burn|blow up|explode|whack"
            rf"|batter|pulveri[sz]e"
            r"|dent|trash|hammer)\b"
            rf"|\b{_NOT}break (?:the|it|this|that|my|your|his|her|all|every|them)\b|\buntil it (?:breaks|bursts"
            rf"|shatters|cracks)\b"
            rf"|\bwhat breaks\b|\b{_NOT}knock (?:the|it|over|down|everything|them)\b|\boff the (?:table|edge"
            rf"|desk|bench)\b[^.;!?]{{0,10}}\b(?:hard|fast)\b"
            rf"|\b{_NOT}(?:push|shove|sweep|knock|slide|kick|nudge) [^.;!?]{{0,40}}\boff the (?:table|edge|desk"
            rf"|bench|shelf)\b"
            rf"|\b{_NOT}(?:drop|let) [^.;!?]{{0,30}}\b(?:on|onto|to) the (?:floor|ground)\b"
            r"|\bfrom as high as\b|\bas hard as\b|\bswing the arm\b|\bswing (?:it|your arm|around)\b"
            r"|\bat full (?:speed|force)\b"
            r"|\bwith (?:all your|full|maximum) force\b|\bscratch the\b|\bsqueeze the (?:\w+ ){1,3}(?:as|until)\b"
            r"|\b(?:push|shove) [^.;!?]{0,30}\bover on\b|\btip (?:over )?the\b|\brip\b|\btear (?:up|apart"
            rf"|the)\b|\b{_NOT}spill\b"
        ),
    ),
)


def find_hostile_request(words: Words) -> HostileRequest | None:
    """The first hostile request in an instruction, None if the rules find none."""
    for kind, pattern in _RULES:
        match = pattern.search(words.text)
        if match is not None:
            return HostileRequest(kind, words.quote(match.start(), match.end()))
    return None
