"""The goal parser: from the words of an instruction and the scene in which it is given to a `Goal`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from dualbrain.grounding.instruction.goals import goal_words
from dualbrain.grounding.instruction.goals.clause_forms import read_clause, refused_clause
from dualbrain.grounding.instruction.goals.goal import (
    Condition,
    Goal,
    Held,
    Observed,
    Placed,
    Pushed,
    RobotEnds,
    Step,
    Unmoved,
    Unread,
)
from dualbrain.grounding.instruction.goals.noun_phrases import Found, Vocabulary
from dualbrain.grounding.instruction.goals.remarks import without_remarks, without_values
from dualbrain.grounding.instruction.stated_values import StatedValue, stated_values
from dualbrain.grounding.instruction.words import without_hidden_characters
from dualbrain.grounding.outcome.spatial_relations import is_container_empty
from dualbrain.records import Scene

PAUSE = re.compile(rf"\b(?:wait|pause)\b|\b{goal_words.DURATION}$")
"""A clause that asks for a pause, alone or while the robot holds an object."""
MAX_CHARACTERS = 400
"""A longer instruction is not read."""
COMMAND = (
    r"(?:put|place|move|set|drop|bring|stand|lay|take|get|carry|transfer|pick|grasp|grab|lift|hold|raise|hand|give|pass|"
    r"push|shove|slide|nudge|go|return|drive|come|retract|park|stop|halt|wait|rest|keep|look|hover|fetch|stack|do not|"
    r"don't|never|leave|let|store|park|collect|gather|relocate|dump|lower|grip|begin|start|head|turn|point|show|find|"
    r"stay|clear|run|stick|pop|hover|see|check|peek|visit|finish|end|freeze|shift|pause|proceed|remain|relocate)\b"
)
ORDINALS = r"(?:next|finally|lastly|last|second(?:ly)?|third(?:ly)?|step (?:two|three|four|[2-9]))\b"
CLAUSE_ENDS = re.compile(
    r" {0,2}[.;!?]+(?!\d) {0,2}|,? {0,2}\b(?:and,? )?(?:then|after that|afterwards|(?:once|when|after) (?:that is done"
    r"|you have finished(?: that| it)?|you are done(?: with that| with it)?)"
    r"|later(?=,? \w)|next(?! to\b| time\b| week\b))\b,? {0,2}"
    rf"|,? {{1,2}}(?:and|but) {{1,2}}(?:(?:you|please|just|simply) ){{0,2}}(?=(?:{ORDINALS},? )?{COMMAND})"
    rf"|[,:] {{0,2}}(?:(?:please|just|so|(?:could|can|would|will) you|you) ){{0,3}}(?=(?:{ORDINALS},? )?{COMMAND})"
)
REFERRING = re.compile(r"\b(?:it|them|that|those|these|this)\b(?! \w+(?:_| (?:bowl|table)))")
CONDITIONAL = re.compile(
    r"if (?:the )?(.+?) is (free|empty|occupied|full),? (?:then )?(.+?)(?:,? (?:else|otherwise),? (.+))?"
)
BEFORE = re.compile(r"before you ([^,]+), (.+)")
"""The second part comes first."""
FOLLOWED = re.compile(rf"([^,]+),? before you ({COMMAND}[^,]+)")
"""The first part comes first."""
AFTER = re.compile(r"(?:^|,? )(?:after|once|when|as soon as) ")
LIES, GOES = (
    re.compile(r" (?:is|are|lies) (?=(?:in|into|at|on) )"),
    re.compile(r" (?:goes|is put) (?=(?:in|into|to|at|on) )"),
)
"""Words between an object and a destination where it is, or where it goes, before or after another action."""
HOME_WORDS = re.compile(
    r"\b(?:home|rest|resting|retract|park|initial|start(?:ed|ing)? ?(?:pose|posture|position)?|"
    r"out of (?:the|my) way|take a break|go back|return|back where|all for today|move away|step back|away)\b"
)
GOING_TO = re.compile(r"\bgo and (?:wait|stand|stay) (?=(?:by|at|near|next|in)\b)|\bget yourself (?:over )?(?=to\b)")
AT_ONCE = ("go", "go ahead", "do it", "off you go")
"""The end of a request of single phrases: "yellow tin. right side of the table. go"."""
NOTHING_ELSE = re.compile(
    r",? ?(?:and|but)? ?(?:everything else (?:stays|remains|(?:can|should|must|may) stay)"
    r"(?: put| as it is| (?:exactly |just |right )?(?:where it is|there))?"
    r"|nothing else(?: on the table)?(?: should be| may be| is)? ?(?:touched|moved)?"
    r"|do not (?:touch|move) anything else|don't (?:touch|move) anything else"
    r"|without (?:touching|moving) anything else|leave everything else(?: (?:exactly |just )?where it is| alone)?)\b"
)


ORDER = re.compile(r"\b(?:then|after|afterwards|once|when|later|next)\b")
"""Words between two clauses that state an order."""
ORDINAL = re.compile(rf"[ ,]*(?:and |but )?{ORDINALS}")
ORDINAL_COMMAND = re.compile(rf"^{ORDINAL.pattern},? (?={COMMAND})")
"""Words at the beginning of a clause that state an order, in front of anything, or of a command."""
FIRST = re.compile(r"(?:first(?: of all)?|before that|beforehand)")
PART_END = re.compile(r"[,.;] (?:and |but )?| but | and ")
DONE_FIRST = (
    re.compile(rf"{FIRST.pattern},? (?!of\b)(.+)"),
    re.compile(rf"((?:please )?{COMMAND}[^,.;]*?),? {FIRST.pattern}"),
)
"""A second part that is to be done first: "put the tin in the bowl, but first go home"."""


@dataclass(frozen=True, slots=True)
class _Clauses:
    """Conditions, steps and pauses read so far, and the objects to which "it" and "them" refer."""

    conditions: tuple[Condition, ...] = ()
    last: tuple[str, ...] = ()
    steps: tuple[tuple[Step, ...], ...] = ()
    visits: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _Clause:
    """The words of one clause; `follows`: an order word precedes them."""

    words: str
    follows: bool = False


def read_goal(instruction: str, scene: Scene) -> Goal | Unread:
    """The goal of `instruction`, given in `scene`; `Unread` if a part of it is not accounted for."""
    return _read(instruction, scene)[0]


def corrected_instruction(instruction: str, scene: Scene) -> str:
    """`instruction` in lower case with misspelled names corrected, if its goal is read only so; else as it is."""
    return _read(instruction, scene)[1]


def _read(instruction: str, scene: Scene) -> tuple[Goal | Unread, str]:
    """The goal, and the words from which it was read: `instruction`, or its corrected form."""
    visible = without_hidden_characters(instruction)
    text = " ".join(visible.lower().replace("\u2019", "'").split())
    if not text or len(text) > MAX_CHARACTERS:
        return Unread(_unreadable(text)), instruction
    vocabulary = Vocabulary(scene)
    if reason := refused_clause(text):
        return Goal(decline=reason), instruction
    corrected = vocabulary.correct_spelling(text)
    spoken = without_remarks(visible, (*scene.graspable, *scene.receptive))
    short = without_values(spoken)
    candidates = (
        (text, instruction),
        (corrected, corrected),
        (short, instruction),
        (vocabulary.correct_spelling(short), corrected),
    )
    first: Goal | Unread | None = None
    for words, shown in dict.fromkeys(candidates):
        goal = _read_words(words, scene, vocabulary)
        if isinstance(goal, Goal) and not goal.decline:
            return _with_values(goal, stated_values(spoken)), shown
        first = first or goal  # "bowll" is no absent thing
    return first or Unread("There is no instruction."), instruction


def _with_values(goal: Goal, values: tuple[StatedValue, ...]) -> Goal:
    """`goal` with the numbers of an instruction; a time is that of a pause, unless the goal is to wait."""
    waits = any(one.parameter == "duration" for one in values) and goal.conditions != (RobotEnds("still"),)
    return replace(goal, values=values, pauses=max(goal.pauses, int(waits)))


def _read_words(text: str, scene: Scene, vocabulary: Vocabulary) -> Goal | Unread:
    if reason := _unreadable(text):
        return Unread(reason)
    if reason := refused_clause(text):
        return Goal(decline=reason)
    return _read_text(vocabulary.join_names(text), scene, vocabulary)


def _unreadable(text: str) -> str:
    """Why the parser cannot read `text` at all; "" if it can."""
    if not text:
        return "There is no instruction."
    if len(text) > MAX_CHARACTERS:
        return f"The instruction is longer than {MAX_CHARACTERS} characters."
    if not text.isascii() or re.search(r"[^a-z0-9_' ,.;:!?()\-]", text):
        return "The instruction contains characters that the goal parser does not read."
    return ""


def requests_home(instruction: str) -> bool:
    """Whether any words of `instruction` may ask the robot to go home or to rest; independent of a scene."""
    return HOME_WORDS.search(instruction.lower()) is not None


def _read_text(text: str, scene: Scene, vocabulary: Vocabulary) -> Goal | Unread:
    if condition := CONDITIONAL.fullmatch(text.rstrip(" .!")):
        return _read_conditional(condition, scene, vocabulary)
    text = GOING_TO.sub("go ", NOTHING_ELSE.sub("", text).replace("take your time and ", ""))
    if swapped := BEFORE.fullmatch(text):
        text = f"{swapped.group(2)}, then {swapped.group(1)}"
    if followed := FOLLOWED.fullmatch(text):
        text = f"{followed.group(1)}, then {followed.group(2)}"
    text = _in_order(text.rstrip(" .!"))
    read = _Clauses()
    clauses = _join_phrases(_clauses(text), vocabulary)
    for number, clause in enumerate(clauses):
        if topic := _topic(clause.words, clauses[number + 1 :], vocabulary):
            read = replace(read, last=topic)
            continue
        found = read_clause(clause.words, scene, vocabulary, read.last)
        if isinstance(found, Unread | Goal):
            return found
        conditions, last = found
        visits = read.visits + _left_places(read.conditions, conditions)
        steps = _with_steps(read.steps, clause, conditions)
        read = _Clauses(_combine(read.conditions, conditions), last or read.last, steps, visits)
    if not read.conditions:
        return Unread("The instruction contains no request that the goal parser knows.")
    conditions = _observe_moved(read.conditions)
    steps = () if conditions == (RobotEnds("still"),) else _valid_steps(read.steps, read.conditions)
    pauses = sum(group == ("wait",) for group in steps)
    return Goal(conditions=conditions, movable=_movable(conditions), steps=steps, pauses=pauses, visits=read.visits)


def _clauses(text: str) -> list[_Clause]:
    """The clauses of `text` without their fillers."""
    clauses: list[_Clause] = []
    position, follows = 0, False
    for end in (*CLAUSE_ENDS.finditer(text), None):
        part = text[position : end.start() if end else len(text)]
        follows = follows or ORDINAL.match(part) is not None
        if words := strip_fillers(ORDINAL_COMMAND.sub("", part)):
            clauses.append(_Clause(words, follows))
            follows = False
        if end:
            position, follows = end.end(), follows or ORDER.search(end[0]) is not None
    return clauses


def _with_steps(
    steps: tuple[tuple[Step, ...], ...], clause: _Clause, conditions: Sequence[Condition]
) -> tuple[tuple[Step, ...], ...]:
    """`steps` with those of `clause`: a group of their own after an order word, a pause or an end of the robot.

    Other clauses may be carried out in any order: "put the cube in the bowl and put the tin on the left side".
    """
    done = tuple(one for one in conditions if not isinstance(one, Unmoved) and one != RobotEnds("still"))
    before = steps[-1] if steps else ()
    stands = any(one == "wait" or isinstance(one, RobotEnds) for one in (*before, *done))
    if done and before and not (clause.follows or stands):
        steps = (*steps[:-1], (*before, *done))
    elif done:
        steps = (*steps, done)
    is_pause = PAUSE.search(clause.words) is not None and tuple(conditions) != (RobotEnds("rest"),)
    return (*steps, ("wait",)) if is_pause else steps


def _valid_steps(steps: Sequence[tuple[Step, ...]], conditions: Sequence[Condition]) -> tuple[tuple[Step, ...], ...]:
    """`steps` without placements that a later clause replaces."""
    kept: list[tuple[Step, ...]] = [
        tuple(one for one in group if not isinstance(one, Placed) or one in conditions) for group in steps
    ]
    return tuple(group for group in kept if group)


def _join_phrases(clauses: Sequence[_Clause], vocabulary: Vocabulary) -> list[_Clause]:
    """`clauses` with a placement in place of an object and a destination that are phrases of their own."""
    phrases = [_Clause(words, clause.follows) for clause in clauses for words in clause.words.split(": ")]
    joined: list[_Clause] = []
    for phrase in phrases:
        before = joined[-1].words if joined else ""
        for thing, destination in ((before, phrase.words), (phrase.words, before)):
            relation = vocabulary.relation_to(destination) if before else ""
            if relation and isinstance(vocabulary.resolve_object(thing), Found):
                joined[-1] = replace(joined[-1], words=f"{thing} {relation} {destination}")
                break
        else:
            joined.append(phrase)
    if len(joined) == len(phrases):
        return list(clauses)
    return joined[:-1] if joined[-1].words in AT_ONCE else joined


def _topic(words: str, following: Sequence[_Clause], vocabulary: Vocabulary) -> tuple[str, ...]:
    """The objects that a clause only names, for a pronoun in the next one: "the brown can, push it to the bowl"."""
    if not following or REFERRING.search(following[0].words) is None:
        return ()
    found = vocabulary.resolve_object(words)
    return found.names if isinstance(found, Found) and found.count is None else ()


def _left_places(before: Sequence[Condition], new: Sequence[Condition]) -> tuple[str, ...]:
    """The place to which `before` asks to drive, if `new` asks to end elsewhere."""
    ends = any(isinstance(one, RobotEnds) for one in new)
    return tuple(one.place for one in before if isinstance(one, RobotEnds) and one.place) if ends else ()


def _in_order(text: str) -> str:
    """`text`, with a placement that precedes or follows another action as a clause of its own.

    "When the tin is in the bowl, go home" and "go home once the tin is in the bowl" both ask for the tin first.
    """
    text = _second_part_first(text)
    head, comma, rest = text.partition(", ")
    after = AFTER.search(text)
    if text.startswith("before ") and comma and len(parts := GOES.split(head.removeprefix("before "), 1)) == 2:
        return f"{rest}, then put {parts[0]} {parts[1]}"
    if after and not after.start() and comma and len(parts := LIES.split(head[after.end() :], 1)) == 2:
        return f"put {parts[0]} {parts[1]}, then {rest}"
    if after and after.start() and len(parts := LIES.split(text[after.end() :], 1)) == 2 and "," not in parts[1]:
        return f"put {parts[0]} {parts[1]}, then {text[: after.start()]}"
    return text


def _second_part_first(text: str) -> str:
    """`text` with a second part that is to be done first in front of the first part."""
    if FIRST.match(text):
        return text
    ends = [end for end in PART_END.finditer(text) if end.start() > 0]
    for form in DONE_FIRST:
        for end in ends:
            if found := form.fullmatch(text, end.end()):
                return f"{found[1]}, then {text[: end.start()].rstrip(',.;')}"
    return text


def _read_conditional(condition: re.Match[str], scene: Scene, vocabulary: Vocabulary) -> Goal | Unread:
    """The goal of the branch whose condition holds in `scene`; without a branch nothing may move."""
    container, state, then, other = condition.groups()
    empty = is_container_empty(scene, container.replace(" ", "_"))
    if empty is None:
        return Unread(f'Whether "{container}" is {state} cannot be perceived.')
    verb = re.match(r"(.+?) (?:in|into|on|onto|at|to)\b", then)
    if other and verb and re.match(r"(?:in|into|on|onto|at|to)\b", other):  # "otherwise on Y": the same object
        other = f"{verb.group(1)} {other}"
    chosen = then if empty == (state in ("free", "empty")) else other
    if chosen is None:
        return Goal(conditions=(RobotEnds("still"),))
    return _read_text(re.sub(r"\bin (?:it|there)\b", f"in the {container}", chosen), scene, vocabulary)


def strip_fillers(clause: str) -> str:
    """`clause` without polite openings and words that do not change its goal."""
    text, before = clause.strip(" ,:"), ""
    while text != before:
        before = text
        text = re.sub(rf"^(?:{goal_words.REQUESTS})\b ?", "", text).strip(" ,:")
        text = re.sub(rf"(?:^|\s|,)(?:{goal_words.FILLERS})(?=$|\s|,)", " ", text)
        text = re.sub(r"^(?:and|but) | (?:and|but)$", "", " ".join(text.split()).strip(" ,:"))
    first, _, rest = text.partition(" ")
    return f"{goal_words.GERUNDS.get(first, first)} {rest}".strip()


def _combine(before: Sequence[Condition], new: Sequence[Condition]) -> tuple[Condition, ...]:
    """`before` and `new`; a placement ends the hold of the same objects, and a later placement replaces an earlier.

    Standing still after another request adds no condition: the robot stops once the request is done. "Do not pick it
    up, push it" asks for the push alone. "Go home, then put it in the bowl" does not ask to end at home.
    """
    if before and tuple(new) == (RobotEnds("still"),):
        return tuple(before)
    placed = {name for one in new if isinstance(one, Placed) for name in one.objects}
    kept = [one for one in before if not (isinstance(one, Held | Placed) and set(one.objects) <= placed)]
    pushed = {name for one in new if isinstance(one, Pushed) for name in one.objects}
    kept = [one for one in kept if not (isinstance(one, Unmoved) and set(one.objects) <= pushed)]
    if new:  # "wait, then go home": it is still before, not at the end
        kept = [one for one in kept if one != RobotEnds("still")]
    if any(isinstance(one, RobotEnds) for one in new):  # only the last end of the robot remains
        kept = [one for one in kept if not isinstance(one, RobotEnds)]
    if any(isinstance(one, Placed | Held | Pushed | Observed) for one in new):
        kept = [one for one in kept if one != RobotEnds("home")]
    return tuple(dict.fromkeys((*kept, *new)))


def _moved(conditions: Sequence[Condition]) -> set[str]:
    return {name for one in conditions if isinstance(one, Placed | Held | Pushed) for name in one.objects}


def _observe_moved(conditions: Sequence[Condition]) -> tuple[Condition, ...]:
    """`conditions`, with the observed objects marked that other conditions move."""
    moved = _moved(conditions)
    return tuple(
        Observed(one.object_name, is_moved=True) if isinstance(one, Observed) and one.object_name in moved else one
        for one in conditions
    )


def _movable(conditions: Sequence[Condition]) -> frozenset[str]:
    kept = {name for one in conditions if isinstance(one, Unmoved) for name in one.objects}
    return frozenset(_moved(conditions) - kept)
