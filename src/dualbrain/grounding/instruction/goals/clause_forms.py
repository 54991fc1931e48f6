"""The forms of one clause that the goal parser knows, each with the conditions that it states."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from dualbrain.grounding.instruction.clauses.clause_patterns import RETRACTION
from dualbrain.grounding.instruction.goals import goal_words
from dualbrain.grounding.instruction.goals.goal import (
    Condition,
    Direction,
    Goal,
    Held,
    Observed,
    Placed,
    Pushed,
    Relation,
    RobotEnds,
    Unmoved,
    Unread,
)
from dualbrain.grounding.instruction.goals.noun_phrases import Absent, Found, Resolved, Unclear, Vocabulary
from dualbrain.grounding.instruction.words import normalise
from dualbrain.records import Scene

PRONOUNS = ("it", "them", "that", "this", "these", "those")
SINGULAR = ("it", "that", "this")
DIRECTIONS: dict[str, Direction] = {
    "away from you": "forward",
    "away from yourself": "forward",
    "away from me": "backward",
    "away": "forward",
    "forward": "forward",
    "forwards": "forward",
    "towards you": "backward",
    "toward you": "backward",
    "towards yourself": "backward",
    "backward": "backward",
    "backwards": "backward",
    "to the left": "left",
    "left": "left",
    "to the right": "right",
    "right": "right",
}
"""Directions in the frame of the robot; "away from me" points to the robot, which faces the person."""
PLACING = re.compile(rf"(?:{goal_words.PLACING_VERBS}) (.+)")
LIFTING = re.compile(
    rf"(?:{goal_words.LIFTING_VERBS}) (.+?)"
    r"(?: up| there| in your hand| in the air| (?:off|from) the (?:table|desk|bench)"
    rf"|(?: by)?(?: about| roughly)? {goal_words.NUMBER}{goal_words.GAP}{goal_words.LENGTH}(?: up| high)?)*"
)
BELONGING = re.compile(
    r" (?:all )?(?:belongs?|goes?|lives?|comes?|moves?|(?:can|could|may|might|wants? to|should|must"
    r"|shall|will|had better"
    r"|has to|have to|has got to|needs? to|ought to|(?:is|are) (?:supposed|meant|to)(?: to)?|would) (?:all )?"
    r"(?:go|live|stand|sit|lie|rest|end up|move|come|be)(?: put| placed| moved| tidied away| stored| sitting| standing"
    r"| lying| resting| better(?: off)?| happier| safer)?"
    r"|needs? (?:putting|placing|moving|clearing|tidying|storing|setting)(?: away)?)(?: over| across)? "
)
"""Between an object and its destination: "the tin belongs in the bowl"."""
STATING = (
    re.compile(
        r"(?:i|we) (?:would like|want|need|'d like|would love|'d love)(?: to (?:see|have))? (.+?)"
        r" ((?:in|on|at|to|into) .+)"
    ),
    re.compile(r"(.+?): ((?:into|in|on|to) .+?)(?: with it)?"),
    re.compile(r"no (.+?) on the table any more: they (?:go) (.+)"),
    re.compile(r"have (.+?) ((?:in|on|at|into) .+)"),
    re.compile(
        r"(?:make sure|ensure|see(?: to it)?)(?: that)? (.+?) (?:is|are|ends? up|gets?|goes"
        r"|lands?) ((?:in|into|on|at|to) .+)"
    ),
)
HANDING = (
    re.compile(rf"(?:{goal_words.HANDING_VERBS}) me (.+)"),
    re.compile(rf"(?:{goal_words.HANDING_VERBS}) (.+?) (?:over )?to (?:{goal_words.RECIPIENTS})"),
    re.compile(rf"(?:{goal_words.PLACING_VERBS}) (.+?) (?:in|into) my hand"),
)
PUSHING = re.compile(rf"(?:{goal_words.PUSHING_VERBS}) (.+)")
OBSERVING = re.compile(rf"(?:{goal_words.OBSERVING_PHRASES}) (.+?)(?: from above| without touching (?:it|them))*")
FORBIDDING = re.compile(
    r"(?:do not|don't|never) (?:touch|move|pick(?: up)?|grasp|take|push|lift|put|place|shift|knock(?: over| into)?|hit"
    r"|bump(?: into)?|disturb|tip(?: over)?) (.+?)(?: up| over)?"
)
LACKING = re.compile(r"what (.+?) (?:lacks|needs|misses) is (.+)")
INTO_WITH = re.compile(r"(?:off )?((?:into|in|onto|on|to) .+?) with (.+)")
"""The destination before the object: "into the bowl with the tins"."""
LETTING = re.compile(r"let (?:go of )?(.+?) (?:(?:drop|fall|slide|go|down) )?((?:into|in|onto|on|at) .+)")
CARRYING = re.compile(r"(?:carry|bring|move|take) (?:it|them)(?: across| over| along| with you| there)+")
GATHERING = re.compile(rf"(?:{goal_words.GATHERING_VERBS}) (.+)")
GIVEN_PUSH = re.compile(r"^give (.+?) an? (?:[a-z]+ ){0,2}?(?:push|nudge|shove)(?= )")
DISTANCE = re.compile(
    rf" (?:about |roughly |some |by |for )*(?:\d{{1,3}}(?:\.\d{{1,3}})?|[a-z]+){goal_words.GAP}"
    r"(?:cm|centimet(?:er|re)s?|mm|millimet(?:er|re)s?|m|met(?:er|re)s?|inch(?:es)?)\b"
)
"""The distance of a push, which contracts state."""
HOLD_TIME = re.compile(rf",? {goal_words.DURATION}$")
KEEPING = re.compile(
    r"(?:leave|keep) (.+?) (?:(?:exactly |just |right )?(?:where it is|where they are|in its place|as it is)|alone)"
)
DRIVING = re.compile(
    r"(?:(?:go|drive|move|come|head|travel|roll|return|run|bring|make your way|stop|stand"
    r"|go and stand|meet (?:me|us)|carry on"
    r"|continue|proceed|end|finish|scoot|get yourself)(?: yourself| on| back| over| off| down| along"
    r"| up| straight| out)*"
    r"(?: to| at| by| for| into| down)|visit|(?:(?:back|over|off|on|down|straight) )*to) (.+?)(?: first| now)?"
)
UNDIRECTED = re.compile(
    r"(?:and )?(?:(?:hold|keep holding|keep|hold up|lift up|keep up)(?: on to)? (?:it|them)|keep hold of (?:it"
    r"|them)|keep it|(?:do not|don't) let (?:it|them) go|(?:do not|don't) let go(?: of (?:it|them))?)"
    r"(?: there| up| in the air| like that| in (?:your|the) (?:hand|gripper)| still| steady| quiet| quietly"
    r"| motionless)*"
)
PARTICIPLES = {
    "put": "put",
    "set": "set",
    "placed": "place",
    "moved": "move",
    "brought": "bring",
    "taken": "take",
    "carried": "carry",
    "dropped": "drop",
    "pushed": "push",
    "shoved": "shove",
    "slid": "slide",
    "nudged": "nudge",
    "shifted": "shift",
    "go": "put",
    "be": "put",
    "live": "put",
    "stand": "put",
    "sit": "put",
    "lifted": "lift",
    "picked": "pick",
    "stood": "stand",
    "laid": "lay",
    "tidied": "tidy",
    "transferred": "transfer",
}
_PARTICIPLE = "|".join(verb for verb in PARTICIPLES if verb not in ("go", "be", "live", "stand", "sit"))
PASSIVE = (
    re.compile(
        r"(?:(?:would|will) it be|is it) (?:possible|ok|okay"
        r"|fine) for (?P<object>.+?) to (?P<verb>go|be|live|stand|sit) "
        r"(?P<rest>(?:in|into|inside|on|onto|to|at|over) .+)"
    ),
    re.compile(
        rf"(?:could|can|might|may|would|will|should|must) (?P<object>.+?) be (?P<verb>{_PARTICIPLE}) (?P<rest>.+)"
    ),
    re.compile(
        r"(?:could|can|might|may|would|should|shall) (?P<object>.+?) (?P<verb>go|be|live|stand|sit) "
        r"(?P<rest>(?:in|into|inside|on|onto|to|at|over) .+)"
    ),
    re.compile(
        r"(?:(?:i|we|(?:my |our |the )?[a-z]+) )?(?:would like|would need|wants?|needs?|'d like|would love|'d love"
        r"|likes?)(?: to (?:have|see))? "
        rf"(?P<object>.+?) (?P<verb>{_PARTICIPLE}) (?P<rest>.+)"
    ),
    re.compile(
        rf"(?P<object>.+?) (?:is to|should|must|has to|have to|needs to|wants to|can"
        rf"|could) be (?P<verb>{_PARTICIPLE}) (?P<rest>.+)"
    ),
)
"""Requests in the passive: "could the tin be pushed towards the bowl", "I want the tin put in the bowl"."""
SIDE_ALONE = re.compile(
    r"(?:the |your )?(left|right|front|back|middle)(?:[- ]hand)?(?: (?:side|half|end|part|area|zone|section))?"
)
PURPOSE = re.compile(r" for (?!a |an |one |now\b|later\b|the (?:moment|time))[a-z' ]{2,30}$")
"""The person or the use at the end of a placement: "in the bowl for my neighbour"."""

Conditions = tuple[tuple[Condition, ...], tuple[str, ...]]
"""Conditions of a clause, and the objects that it names."""
Form = Callable[[str, Scene, Vocabulary, tuple[str, ...]], "Conditions | Goal | Unread | None"]


def refused_clause(text: str) -> str:
    """Why an instruction with the words `text` is to be declined in any scene; "" if it need not be."""
    if withdrawn := RETRACTION.search(normalise(text).text):
        return f'"{withdrawn[0].strip()}" withdraws the request'
    words = set(re.findall(r"[a-z-]+", text))
    for phrase in goal_words.UNAUTHORISED_PHRASES:
        if phrase in text and not re.search(r"\b(?:do not|don't|never)\b", text):
            return f'no instruction may change or reveal "{phrase}"'
    openings = {opening.split()[0] for opening in _openings(text) if opening}
    if words & {"gripper", "fingers"}:  # "open the gripper" is within the skills
        openings -= {"open"}
    if words & {"yourself", "arm"}:  # "fold the arm" asks for the home posture
        openings -= {"fold"}
    if verb := next(iter(sorted(openings & goal_words.HAZARD_VERBS)), ""):
        thrown = verb == "throw" and re.search(r"\b(?:in|into)\b", text) and not words & goal_words.PERSONS
        return "" if thrown else f'"{verb}" could injure a person or damage an object'
    if verb := next(iter(sorted(openings & goal_words.IMPOSSIBLE_VERBS)), ""):
        return f'no skill of this robot can "{verb}"'
    return ""


def _openings(text: str) -> list[str]:
    """The parts of `text` that may begin with a verb, without polite openings."""
    parts = re.split(r"[.;!?,:]| and | then | but ", text)
    return [re.sub(rf"^(?:{goal_words.REQUESTS}|please|{goal_words.FILLERS})\b ?", "", one.strip()) for one in parts]


def read_clause(text: str, scene: Scene, vocabulary: Vocabulary, last: tuple[str, ...]) -> Conditions | Goal | Unread:
    """The conditions of the clause `text`; a `Goal` if it is to be declined. "it" refers to the objects `last`."""
    if passive := next((match for one in PASSIVE if (match := one.fullmatch(text))), None):
        text = f"{PARTICIPLES[passive['verb']]} {passive['object']} {passive['rest']}"
    for form in FORMS:
        found = form(text, scene, vocabulary, last)
        if found is not None:
            return found
    return Unread(f'The goal parser does not know the form of "{text}".')


# --- forms ------------------------------------------------------------------------------------------------------------


def _robot_ends(text: str, scene: Scene, vocabulary: Vocabulary, last: tuple[str, ...]) -> Conditions | None:
    if last and UNDIRECTED.fullmatch(text):
        return None
    if any(re.fullmatch(form, text) for form in goal_words.REST_CLAUSES):
        return (RobotEnds("rest"),), last
    if any(re.fullmatch(form, text) for form in goal_words.STILL_CLAUSES):
        return (RobotEnds("still"),), last
    if any(re.fullmatch(form, text) for form in goal_words.HOME_CLAUSES):
        return (RobotEnds("home"),), last
    return None


def _forbidden(
    text: str, scene: Scene, vocabulary: Vocabulary, last: tuple[str, ...]
) -> Conditions | Goal | Unread | None:
    form = FORBIDDING.fullmatch(text) or KEEPING.fullmatch(text)
    if form is None:
        return None
    _, phrase, rest = (*_splits(form.group(1)), ("at", form.group(1), ""))[0]
    if rest and not isinstance(vocabulary.resolve_reference(rest), Found):
        return Unread(f'"{rest}" is not accounted for.')
    objects = _objects(phrase, vocabulary, last)
    if isinstance(objects, Unread) and isinstance(vocabulary.resolve_reference(phrase), Found):
        found = vocabulary.resolve_reference(phrase)
        return ((Unmoved(found.names),), last) if isinstance(found, Found) else objects
    if not isinstance(objects, Found):
        return Unread(f'"{phrase}" names nothing that may be left alone.') if isinstance(objects, Goal) else objects
    return (Unmoved(objects.names),), objects.names


def _handed(
    text: str, scene: Scene, vocabulary: Vocabulary, last: tuple[str, ...]
) -> Conditions | Goal | Unread | None:
    form = next((match for one in HANDING if (match := one.fullmatch(text))), None)
    if form is None:
        return None
    objects = _objects(form.group(1), vocabulary, last)
    return ((Held(objects.names, handed=True),), objects.names) if isinstance(objects, Found) else objects


def _observed(
    text: str, scene: Scene, vocabulary: Vocabulary, last: tuple[str, ...]
) -> Conditions | Goal | Unread | None:
    form = OBSERVING.fullmatch(text)
    if form is None:
        return None
    if form.group(1) in PRONOUNS:
        return (
            ((Observed(last[0]),), last)
            if len(last) == 1
            else Unread(f'"{form.group(1)}" does not refer to one object.')
        )
    found = vocabulary.resolve_reference(form.group(1))
    if not isinstance(found, Found):
        return _unresolved(found)
    return (Observed(found.names[0]),), found.names


def _pushed(
    text: str, scene: Scene, vocabulary: Vocabulary, last: tuple[str, ...]
) -> Conditions | Goal | Unread | None:
    form = PUSHING.fullmatch(GIVEN_PUSH.sub(r"push \1", text))
    if form is None:
        return None
    words = re.sub(
        r" (?:without lifting it|a little|a bit|a tiny bit|a touch|slightly|somewhere|some way)\b", "", form.group(1)
    )
    words = DISTANCE.sub("", words)
    if off := re.fullmatch(r"(.+?) off (?:of )?(?:the )?(?:table|edge)", words):
        return Goal(decline=f"pushing {off.group(1)} off the table could damage it")
    for phrase, direction in DIRECTIONS.items():
        if words.endswith(f" {phrase}"):
            objects = _objects(words.removesuffix(phrase).strip(), vocabulary, last)
            if not isinstance(objects, Found):
                return objects
            if place := _place_that_way(objects.names, direction, scene, vocabulary):
                return (Pushed(objects.names, "toward", place),), objects.names
            return (Pushed(objects.names, direction),), objects.names
    return _pushed_relative(words, vocabulary, last)


def _place_that_way(names: Sequence[str], direction: Direction, scene: Scene, vocabulary: Vocabulary) -> str | None:
    """The place on the side `direction` (left or right), if it is that way from all objects `names`; else None.

    That way: the direction from the object to the place is within 45 degrees of the side. Left of the robot is +y.
    """
    name = vocabulary.place_on_side(direction)
    place = next((one for one in scene.places if one.name == name), None)
    if place is None or direction not in ("left", "right"):
        return None
    sign = 1.0 if direction == "left" else -1.0
    offsets = [
        (place.position[0] - one.pose.position[0], sign * (place.position[1] - one.pose.position[1]))
        for one in scene.objects
        if one.name in names
    ]
    return place.name if all(aside > abs(ahead) for ahead, aside in offsets) else None


def _pushed_relative(words: str, vocabulary: Vocabulary, last: tuple[str, ...]) -> Conditions | Goal | Unread | None:
    form = re.fullmatch(
        r"(.+?) (?:(?:over|up|along|across|back) )*(towards?|closer to|in (?:the )?direction of|away from|to"
        r"|against|into|in) (.+)",
        words,
    )
    if form is None:
        return None
    objects, reference = _objects(form.group(1), vocabulary, last), vocabulary.resolve_reference(form.group(3))
    if (side := SIDE_ALONE.fullmatch(form.group(3))) and (place := vocabulary.place_on_side(side[1])):
        reference = Found((place,))
    if not isinstance(objects, Found):
        return objects
    if not isinstance(reference, Found):
        return _unresolved(reference)
    direction: Direction = "away_from" if form.group(2) == "away from" else "toward"
    return (Pushed(objects.names, direction, reference.names[0]),), objects.names


def _placed(
    text: str, scene: Scene, vocabulary: Vocabulary, last: tuple[str, ...]
) -> Conditions | Goal | Unread | None:
    form = PLACING.fullmatch(text)
    return _placements(form.group(1), vocabulary, last) if form else None


def _placements(words: str, vocabulary: Vocabulary, last: tuple[str, ...]) -> Conditions | Goal | Unread | None:
    """One placement, or several in a list."""
    found = _placement(words, vocabulary, last)
    if isinstance(found, tuple):
        return found
    for joint in re.finditer(r",? and |, ", words):  # "X in Y, Z on W and V in U"
        head = _placement(words[: joint.start()], vocabulary, last)
        rest = _placements(words[joint.end() :], vocabulary, last) if isinstance(head, tuple) else None
        if isinstance(head, tuple) and isinstance(rest, tuple):
            return (*head[0], *rest[0]), (*head[1], *rest[1])
    return found


def _continued(
    text: str, scene: Scene, vocabulary: Vocabulary, last: tuple[str, ...]
) -> Conditions | Goal | Unread | None:
    """A placement without a verb: "all tins into the bowl", "then the tin to the left side of the table"."""
    found = _placements(text, vocabulary, last)
    stated = isinstance(found, tuple) and all(
        isinstance(one, Placed) and one.relation in ("in", "at") for one in found[0]
    )
    return found if last or stated else None


def _stated(
    text: str, scene: Scene, vocabulary: Vocabulary, last: tuple[str, ...]
) -> Conditions | Goal | Unread | None:
    if lacking := LACKING.fullmatch(text):
        return _placement(f"{lacking.group(2)} in {lacking.group(1)}", vocabulary, last)
    if inverted := INTO_WITH.fullmatch(text):
        return _placement(f"{inverted.group(2)} {inverted.group(1)}", vocabulary, last)
    if letting := LETTING.fullmatch(text):
        return _placement(f"{letting.group(1)} {letting.group(2)}", vocabulary, last)
    if belonging := BELONGING.search(text):
        found = _placement(f"{text[: belonging.start()]} {text[belonging.end() :]}", vocabulary, last)
    elif form := next((match for one in STATING if (match := one.fullmatch(text))), None):
        found = _placement(f"{form.group(1)} {form.group(2)}", vocabulary, last)
    else:
        return None
    for joint in re.finditer(r",? and ", text) if not isinstance(found, tuple) else ():  # "X goes in Y and Z goes on W"
        parts = [_stated(one, scene, vocabulary, last) for one in (text[: joint.start()], text[joint.end() :])]
        pairs = [one for one in parts if isinstance(one, tuple)]
        if len(pairs) == len(parts):
            return tuple(c for one in pairs for c in one[0]), tuple(n for one in pairs for n in one[1])
    return found


def _held(text: str, scene: Scene, vocabulary: Vocabulary, last: tuple[str, ...]) -> Conditions | Goal | Unread | None:
    text = HOLD_TIME.sub("", text)
    if UNDIRECTED.fullmatch(text):
        return ((Held(last),), last) if last else Unread('"it" refers to nothing.')
    form = LIFTING.fullmatch(text)
    if form is None:
        return None
    objects = _objects(form.group(1), vocabulary, last)
    if not isinstance(objects, Found):
        return objects
    if objects.count not in (None, 1, len(objects.names)):
        return Unread(f'"{form.group(1)}" may be several objects.')
    one = len(objects.names) == 1 or objects.count == 1  # several are held one after the other, for a later clause
    return ((Held(objects.names),) if one else ()), objects.names


def _gathered(text: str, scene: Scene, vocabulary: Vocabulary, last: tuple[str, ...]) -> Conditions | None:
    """A clause that only names objects for the next one: "collect the tins", "carry it across"."""
    if last and CARRYING.fullmatch(text):
        return (), last
    form = GATHERING.fullmatch(text)
    found = _objects(form.group(1), vocabulary, last) if form else None
    return ((), found.names) if isinstance(found, Found) else None


def _driven(text: str, scene: Scene, vocabulary: Vocabulary, last: tuple[str, ...]) -> Conditions | Unread | None:
    form = DRIVING.fullmatch(text)
    if form is None and not vocabulary.drives:
        return None
    phrase = form.group(1) if form else text
    found = vocabulary.resolve_reference(phrase)
    if form is None and not isinstance(found, Found):
        return None
    if isinstance(found, Found) and found.names[0] in vocabulary.places:
        return (RobotEnds("drive", found.names[0]),), last
    return Unread(f'"{phrase}" is no place of the scene.')


FORMS: tuple[Form, ...] = (
    _robot_ends,
    _forbidden,
    _handed,
    _observed,
    _pushed,
    _placed,
    _stated,
    _gathered,
    _held,
    _driven,
    _continued,
)


# --- parts of a clause ------------------------------------------------------------------------------------------------


def _placement(words: str, vocabulary: Vocabulary, last: tuple[str, ...]) -> Conditions | Goal | Unread | None:
    """The placement "NOUN PHRASE PREPOSITION REFERENCE", at the first preposition after which both parts resolve."""
    first: Goal | Unread | None = None
    words = re.sub(r" (?:down|up|back|over|away|round|around|out|along|across)(?= (?!from|of)|$)", "", words)
    for relation, phrase, rest in _splits(words) or _listed(words):
        objects = _objects(phrase, vocabulary, last)
        references = _references(rest, relation, vocabulary, last)
        if isinstance(objects, Found) and isinstance(references, tuple):
            names = tuple(name for name in objects.names if name not in references)
            if not names:
                return Unread(f'"{phrase}" cannot be placed relative to itself.')
            return (Placed(names, _at_or_in(relation, references[0], vocabulary), references, objects.count),), names
        failure = objects if not isinstance(objects, Found) else references
        first = first or (failure if isinstance(failure, Goal | Unread) else None)
    return first


def _listed(words: str) -> list[tuple[Relation, str, str]]:
    """The parts of "the tin, table_left" and "the tin left", placements without a preposition."""
    phrase, comma, rest = words.rpartition(", ")
    if not comma and re.search(r" (?:left|right)$", words):  # "the tin left"
        phrase, comma, rest = words.rpartition(" ")
    return [("at", phrase, rest)] if comma and "," not in phrase else []


def _splits(words: str) -> list[tuple[Relation, str, str]]:
    found: list[tuple[int, Relation, str, str]] = []
    taken: list[tuple[int, int]] = []
    for pattern, relation in goal_words.PREPOSITIONS:
        for match in re.finditer(rf" (?:{pattern}) ", f"{words} "):
            start, end = match.start(), match.end() - 1
            if any(start < b and a < end for a, b in taken):
                continue
            taken.append((start, end))
            found.append((start, relation, words[:start], words[end:].strip()))
    return [(relation, phrase, rest) for _, relation, phrase, rest in sorted(found) if phrase and rest]


def _at_or_in(relation: Relation, reference: str, vocabulary: Vocabulary) -> Relation:
    """The relation that "to", "on" and "in" mean: inside a container, at a place, on an object; near a place: at it."""
    if relation in ("at", "on", "in", "near") and reference in vocabulary.places:
        return "at"
    if relation not in ("at", "on", "in"):
        return relation
    if any(obj.name == reference for obj in vocabulary.containers):
        return "in"
    return "on"


def _objects(phrase: str, vocabulary: Vocabulary, last: tuple[str, ...]) -> Found | Goal | Unread:
    if phrase.strip() in PRONOUNS:  # "pick one of the blocks and put it …": one of them
        one = 1 if len(last) > 1 and phrase.strip() in SINGULAR else None
        return Found(last, one) if last else Unread(f'"{phrase}" refers to nothing.')
    found = vocabulary.resolve_object(phrase)
    if isinstance(found, Absent) and isinstance(vocabulary.resolve_reference(phrase), Found):
        return Goal(decline=f'no skill moves "{phrase}"')  # a container or a place
    return found if isinstance(found, Found) else _unresolved(found)


def _references(
    phrase: str, relation: Relation, vocabulary: Vocabulary, last: tuple[str, ...]
) -> tuple[str, ...] | Goal | Unread:
    if relation == "between":
        parts = re.split(r" and ", phrase)
        found = [vocabulary.resolve_reference(part) for part in parts]
        if len(found) == 2 and all(isinstance(one, Found) for one in found):
            return tuple(one.names[0] for one in found if isinstance(one, Found))
        return Unread(f'"between {phrase}" does not name two objects.')
    if phrase in ("the table", "table") and relation in ("on", "off", "under"):
        return Unread(f'"{relation} the table" does not state where.')
    if (side := SIDE_ALONE.fullmatch(phrase)) and relation in ("at", "on"):
        place = vocabulary.place_on_side(side[1])
        return (place,) if place else Unread(f'"{phrase}" does not mean one place.')
    one = vocabulary.resolve_reference(phrase)
    if not isinstance(one, Found) and (shorter := PURPOSE.sub("", phrase)) != phrase:
        return _references(shorter, relation, vocabulary, last)
    return one.names if isinstance(one, Found) else _unresolved(one)


def _unresolved(found: Resolved) -> Goal | Unread:
    match found:
        case Absent(phrase):
            return Goal(decline=f'there is no "{phrase}" in the scene', absent=phrase)
        case Unclear(reason):
            return Unread(f"{reason[0].upper()}{reason[1:]}.")
        case Found():
            return Unread("The phrase names an object that is not expected here.")
