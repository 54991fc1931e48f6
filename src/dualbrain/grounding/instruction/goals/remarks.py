"""Remarks in an instruction: parts that state something about people or the present, and ask for nothing.

"My hands are full, so could you put the tin in the bowl? It's for my neighbour." asks for one placement. If the goal
parser does not know the form of an instruction, it reads the instruction again without remarks and numbers.

A part is a remark if it has the form of a statement, names nothing in the scene, and has no word of a wish, an
obligation, a permission, an order in time or a condition. A part in doubt is no remark, and the goal is then not read.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Collection
from itertools import takewhile

from dualbrain.grounding.instruction.clauses.clause_patterns import POLITE_CONDITION
from dualbrain.grounding.instruction.clauses.masks.contrasts import PRESENT_PLACE
from dualbrain.grounding.instruction.goals import goal_words
from dualbrain.grounding.instruction.names import SIDES, singular
from dualbrain.grounding.instruction.stated_values import VALUE_PHRASES
from dualbrain.grounding.instruction.words import normalise

_PRONOUN = r"(?:i|we|he|she|they|it|that|this|there|everyone|everybody|somebody|someone|nobody)(?:'(?:s|m|re|ve|d|ll))?"
_OWNED = r"(?:my|our|his|her|their|mr|mrs|ms|dr|the|a|an|those|these)"
_SUBJECT = rf"(?:{_PRONOUN}\b|{_OWNED} \w)"
_BOUNDARY = re.compile(
    r" ?[.!?;:,()](?!\d) ?"
    rf"|(?: |^)(?=(?:because|cause|cos|since|so|and|but) (?:that )?{_SUBJECT})"
)
"""The end of a part: a punctuation mark, or a conjunction in front of a subject."""
_OPENING = re.compile(
    r"(?:(?:oh|ah|well|right|now|ok|okay|yes|yeah|no|look|actually|honestly|sorry|and|but|so(?: that)?|because"
    r"|cause|cos"
    r"|since|anyway|hey|you know|you see|apparently|unfortunately|sadly|obviously|i (?:think|believe|guess|suppose"
    r"|am afraid|hope)) )+"
)
_FINITE = (
    r"(?:is|are|am|was|were|has|have|had|will|would|can|could|does|do|did|needs?|keeps?|kept|comes?|came|went|got|gets?"
    r"|looks?|hurts?|aches?|broke|spilled|spilt|left|sent|asked|said|arrived|works?|sleeps?|plays?|eats?|wants?|likes?|arrives?|starts?|begins?|ends?|says?|thinks?|feels?|forgets?|forgot"
    r"|always|never|takes?|sits?|stands?|lies|gave|made|makes?|bought|lost|finished|closes?|opens?|rings?|sounds?|smells?)"
)
_STATEMENT = re.compile(
    rf"{_PRONOUN} \w+|{_OWNED} (?:\w+ ){{1,4}}?{_FINITE}\b|{_OWNED} (?:\w+ ){{0,3}}?\w+'s \w+"
    r"|[a-z]+ (?:wants|needs|says|said|asked|loves|likes|thinks|told|works|comes) \w+|\w+ (?:always|never|still"
    r"|just|already|usually|often) \w+|(?:\w+ ){1,2}?(?:is|are|was|were|has|had) \w+|\w+'s (?:\w+ing|here|there|got"
    r"|been|on|at|in|not|just|about|gone) ?"
)
"""The beginning of a statement: a pronoun, a noun phrase with a verb, or a name with "is"."""
_DEPENDENCE = re.compile(
    r"\b(?:if|unless|until|when|whenever|once|while|before|after|afterwards|as long|only|except|instead|rather"
    r"|otherwise"
    r"|else|(?<!my )(?<!our )first|then|later|next|where|wherever|which|whether|or|either|neither|nor|without|but"
    r"|last|assuming|provided|providing|suppose|supposing|given|in case|as)\b"
)
"""Words by which a request can depend on the part, or by which the part continues a request."""
_DEMAND = re.compile(
    r"\b(?:should|shall|must|ought|supposed|allowed|permitted|forbidden|let|please|make sure|ensure|goes|belongs?"
    r"|stays?|remains?|leave|keep|mean|means|meant|order|orders|tell|tells|expect|prefers?|insists?|decided"
    r"|(?:has|have|needs?|wants?|is|are|like|likes|would like|would love|time) to (?:be|go|stay|have|get|end|stand|lie)"
    r"|(?:want|wants|need|needs|like|likes|love|wish|asked|asks|ask) (?:for )?"
    r"(?:(?:it|them|you|one|some|all|both|everything|nothing)|(?:that|this|these|those)(?= (?:in|on|at|to|here"
    r"|there|put|moved|done|back|away)\b|$)))\b"
)
"""Words of a wish, an order or a permission: the part may be a request itself."""
_OWN_DUTY = re.compile(r"^(?:i|we) (?:must|should|ought to|have to|need to|had to|have got to) (?!have\b)")
"""An obligation of the speaker, which is none of the robot."""
_LEFT_BEHIND = re.compile(r"\bleft (?=(?:the|that|this|it|them|my|our|his|her|their|an?)\b)")
"""The verb, not the side: "my kid left that"."""
_OWN_PLAN = re.compile(
    r"^(?:i|we) (?:will|am going to|are going to|am|are) (?!need|want|have|like|take|be (?:glad|happy|grateful))"
)
"""A plan of the speaker: "I'll try and keep my arm out of your way"."""
_OWN_ACTION = re.compile(
    r"(?:we|it|that|this|they) (?:can |could |will |now |just |then |may )*"
    rf"(?:{goal_words.PLACING_VERBS}|{goal_words.LIFTING_VERBS}|{goal_words.PUSHING_VERBS})s?\b"
)
"""A request as a statement: "we put the tins in the bowl now"."""
_NEGATED_THING = re.compile(r"(?:it|that|this|they|there|the|those|these)\b.*\b(?:not|never|no|nothing)\b")
_ABOUT_A_THING = re.compile(
    r"(?P<topic>(?:the |that |this |my |our )?(?:[a-z]+ ){0,2}[a-z]+) (?:is|was|looks|came|comes|has|nearly|almost"
    r"|still) (?P<rest>[a-z' ]+)"
)
_EXISTING_THING = re.compile(
    r"there is (?:an?|the|some|another) (?P<topic>(?:[a-z]+ ){0,2}?[a-z]+)(?: (?:hiding|sitting|standing|lying|waiting"
    r"|left|over|somewhere|on|in|among|amongst|between|behind|near|right|out)\b[a-z ]*)?"
)
"""A thing that only is there, for a pronoun after it: "there is a pink tin among the bottles"."""
_THING = re.compile(r"\b(?=((?:the|that|this|my|our|your|an?)(?: [a-z]+){1,3}))")
_PRONOUN_OBJECT = re.compile(r"\b(?:it|that)\b(?! is\b| was\b)")
_PHRASE = rf"(?>(?:{goal_words.SOCIAL})(?= |$))"
_SOCIAL = re.compile(rf"{_PHRASE}(?: {_PHRASE})*+")
"""Social phrases alone; the groups are atomic, so that the time is linear in the length of the text."""
_SEVERAL = re.compile(r"\b(?:all|every|everything|each|both|any|[a-z]+s)\b(?= .*, (?:and |but )?not )")
_CONTRAST = re.compile(
    rf" (?:, )?{PRESENT_PLACE}|(?: ,| and| but)+ not (?:(?:out|over|just|lying|sitting) )*(?:here|there)"
    r"(?: on the (?:table|bench|desk))?(?= ?[,.;:!?]|$)"
    r"| ?, (?:and |but )?not (?:in |on |at |to )?(?:the |that )[a-z ]{2,25}?(?= ?[,.;:!?]| (?:in"
    r"|into|on|onto|to|at) |$)"
)
"""The thing or the place that is not meant: "the orange can, not the orange tin"."""
_POLITE = re.compile(
    rf"(?:{POLITE_CONDITION.pattern})(?: (?:kind|good|nice|to|for me|to you|a (?:second|moment|minute)))*"
)


def without_remarks(instruction: str, names: Collection[str]) -> str:
    """The normal form of `instruction` without its remarks and courtesies; `names` are those of the scene."""
    text = re.sub(r"\b(mr|mrs|ms|dr) \.", r"\1", normalise(instruction).text)
    text = _POLITE.sub(" ", re.sub(r"(?<!\d )\bn\b(?! ?[/.\d])", "and", _without_accents(text)))
    if not _SEVERAL.search(text):
        text = _CONTRAST.sub("", text)
    known = _scene_words(names)
    kept, position = "", 0
    for start, end in _parts(text):
        part = text[start:end]
        topic = _topic(part, text[end:], known)
        if topic or is_remark(part, known):
            kept += f"{text[position:start]} {topic}"
            position = end
    return _tidy(kept + text[position:])


def without_values(text: str) -> str:
    """`text` in normal form without numbers for parameters, which change no object and no destination."""
    return _tidy(VALUE_PHRASES.sub(" ", text))


def is_remark(part: str, known: Collection[str]) -> bool:
    """Whether one `part` of an instruction, without punctuation, asks for nothing; `known` are words of the scene."""
    words = _LEFT_BEHIND.sub("had ", _OPENING.sub("", part.strip(), count=1))
    if _SOCIAL.fullmatch(part.strip()) or _SOCIAL.fullmatch(words):
        return True
    if not _STATEMENT.match(words) or any(singular(word) in known for word in re.findall(r"[a-z]+", words)):
        return False
    if _DEPENDENCE.search(words) or _NEGATED_THING.match(words):
        return False
    if _DEMAND.search(_OWN_DUTY.sub("", words)) and not _OWN_PLAN.match(words):
        return False
    return _OWN_ACTION.match(words) is None


def _topic(part: str, following: str, known: Collection[str]) -> str:
    """The subject of a remark about a thing, for a pronoun after it: "the glass is new, so grip it with 3 N"."""
    if not _PRONOUN_OBJECT.search(following):
        return ""
    words = _OPENING.sub("", part.strip(), count=1)
    if existing := _EXISTING_THING.fullmatch(words):
        return f"the {existing['topic']}. "
    match = _ABOUT_A_THING.fullmatch(words)
    if match is not None and is_remark(f"that is {match['rest']}", known):
        return f"{match['topic']}. "
    return _only_thing(words, known)


def _only_thing(words: str, known: Collection[str]) -> str:
    """The only thing of the scene in a remark about a person: "my kid left the purple block lying about"."""
    for match in _THING.finditer(words):
        article, *nouns = match[1].split()
        named = list(takewhile(lambda noun: singular(noun) in known, nouns))
        phrase = " ".join((article, *named))
        if named and is_remark(words[: match.start()] + "that" + words[match.start() + len(phrase) :], known):
            return f"{phrase}. "
    return ""


def _without_accents(text: str) -> str:
    """`text` with the letters of ASCII in place of their accented forms."""
    decomposed = unicodedata.normalize("NFKD", text.replace("\u00df", "ss"))
    return "".join(one for one in decomposed if not unicodedata.combining(one))


def _scene_words(names: Collection[str]) -> frozenset[str]:
    """Words that may name something in the scene: parts of `names`, their synonyms, colors, sides, general nouns."""
    parts = {part for name in names for part in name.lower().split("_") if not part.isdigit()} - {"table"}
    similar = {word for group in goal_words.SYNONYMS if not parts.isdisjoint(group) for word in group}
    general = goal_words.GENERIC_NOUNS | goal_words.GENERAL_CONTAINERS | {"other", "rest", "everything", "anything"}
    return frozenset(parts | similar | goal_words.COLOURS | set(SIDES) | general)


def _parts(text: str) -> list[tuple[int, int]]:
    """Start and end of the parts of `text` between punctuation marks and conjunctions in front of a subject."""
    found: list[tuple[int, int]] = []
    start = 0
    for match in _BOUNDARY.finditer(text):
        found.append((start, match.start()))
        start = match.end()
    return [(first, last) for first, last in (*found, (start, len(text))) if text[first:last].strip()]


def _tidy(text: str) -> str:
    """`text` with single spaces, and with one punctuation mark where several are left."""
    text = re.sub(r" +(?=[.!?;:,)])", "", " ".join(text.split()))
    text = re.sub(r"[,;:](?=[.!?;:,])|(?<=[.!?])[.!?;:,]+", "", text)
    return re.sub(r"^[.!?;:, ]+|(?<=[.!?;:,]) (?:and|but|so)(?=[.!?;:,])", "", text).strip()
