"""Vocabulary of the goal parser: verbs, prepositions, quantifiers, and words that do not change a goal."""

from __future__ import annotations

import tomllib
from pathlib import Path

import msgspec

from dualbrain.grounding.instruction.goals.goal import Relation
from dualbrain.grounding.instruction.words import NUMBER_WORDS


class _Vocabulary(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The lists in `goal_vocabulary.toml`."""

    hazard_verbs: frozenset[str]
    impossible_verbs: frozenset[str]
    unauthorised_phrases: tuple[str, ...]
    persons: frozenset[str]
    determiners: frozenset[str]
    generic_nouns: frozenset[str]
    general_containers: frozenset[str]
    colours: frozenset[str]
    no_objects: frozenset[str]
    synonyms: tuple[frozenset[str], ...]
    cautions: tuple[str, ...]
    courtesies: tuple[str, ...]
    social: tuple[str, ...]
    fillers: tuple[str, ...]
    requests: tuple[str, ...]
    structure_words: frozenset[str]
    recipients: tuple[str, ...]
    gerunds: dict[str, str]


_FILE = Path(__file__).with_name("goal_vocabulary.toml")
_WORDS = msgspec.convert(tomllib.loads(_FILE.read_text(encoding="utf-8")), _Vocabulary)

HAZARD_VERBS, IMPOSSIBLE_VERBS = _WORDS.hazard_verbs, _WORDS.impossible_verbs
UNAUTHORISED_PHRASES, PERSONS = _WORDS.unauthorised_phrases, _WORDS.persons
DETERMINERS, GENERIC_NOUNS, COLOURS = _WORDS.determiners, _WORDS.generic_nouns, _WORDS.colours
GENERAL_CONTAINERS, STRUCTURE_WORDS = _WORDS.general_containers, _WORDS.structure_words
NO_OBJECTS, SYNONYMS, GERUNDS = _WORDS.no_objects, _WORDS.synonyms, _WORDS.gerunds
CAUTIONS, COURTESIES, SOCIAL, REQUESTS, RECIPIENTS = (
    "|".join(words) for words in (_WORDS.cautions, _WORDS.courtesies, _WORDS.social, _WORDS.requests, _WORDS.recipients)
)
"""Alternatives of a regular expression."""
FILLERS = "|".join((*_WORDS.cautions, *_WORDS.courtesies, *_WORDS.fillers))
"""Alternatives of a regular expression: all words that change neither the goal nor what may move."""

NUMBER = rf"(?:\d{{1,4}}(?:[.,]\d{{1,3}})?|an?|{'|'.join(NUMBER_WORDS)}|half an?)"
GAP = r"(?: |(?<=\d))"
"""Between a number and its unit: a space, or nothing after a digit."""
LENGTH = r"(?:cm|mm|centimet(?:er|re)s?|millimet(?:er|re)s?|met(?:er|re)s?|inch(?:es)?)"
DURATION = rf"(?:for |of )?(?:(?:about|around|roughly|some|like|just) )*{NUMBER}{GAP}(?:s|secs?|seconds?)(?: or so)?"
PLACING_VERBS = (
    "put|place|move|set|drop|bring|stand|lay|transfer|carry(?! on)|take|get|deposit|shift|stow|pop|stick|collect"
    "|gather|"
    "sort|throw|tidy|drag|transport|insert|position|return|leave|stack|bring over|put away|store|park|relocate|dump|"
    "lower|load|add|clear|chuck|plonk|plop"
)
"""Verbs of a placement; with a destination none of them determines how the object gets there."""
LIFTING_VERBS = (
    "pick up|pick|take up|grasp|grab|grip|lift up|lift|take hold of|take|hold up|hold on to|hold|raise"
    "|get hold of|fetch"
)
GATHERING_VERBS = "collect|gather up|gather|find|pick out|start with|begin with|take care of"
"""Verbs that name objects for a later clause."""
HANDING_VERBS = "hand|give|pass|bring|hand over|fetch|get"
PUSHING_VERBS = "push|shove|slide|nudge|scoot|budge|edge"
OBSERVING_PHRASES = (
    "look at|have a look at|hover over|hover above|point at|point to|check on|move above|move your hand above|"
    "hold your hand over|go over|go above|show me|inspect|"
    "have a (?:quick |good |close |closer )?(?:look|peek) (?:at|on)|look on|(?:position|put|place|bring|hold|move) "
    "yourself (?:right |just )?(?:over|above)|"
    rf"hover {NUMBER}{GAP}{LENGTH} (?:over|above)|"
    "(?:go )?see|peek at|glance at|take a (?:quick |good |close |closer )?look at|take a (?:quick |good |close "
    "|closer )?(?:look|peek) on|take a peek at|check out|check|view|"
    "(?:position|put|place|bring|hold|move) (?:your|the) (?:empty |free |open )?(?:hand|gripper|fingers|arm) "
    "(?:right |just )?(?:over|above)"
)

PREPOSITIONS: tuple[tuple[str, Relation], ...] = (
    (r"(?:to|on|at) the left(?:[- ]hand)?(?: side)? of|left of", "left_of"),
    (r"(?:to|on|at) the right(?:[- ]hand)?(?: side)? of|right of", "right_of"),
    (r"in front of|before", "in_front_of"),
    (r"behind|in back of", "behind"),
    (r"between", "between"),
    (r"next to|beside|besides|close to|near to|near|by|alongside|adjacent to|around", "near"),
    (r"on top of|onto|on|upon|atop", "on"),
    (r"into|inside(?: of)?|in", "in"),
    (r"under(?:neath)?|below|beneath", "under"),
    (r"above|over", "above"),
    (r"away from|far from", "away_from"),
    (r"off of|off|out of|from", "off"),
    (r"at|over to|to", "at"),
)
"""Prepositions of a placement and their relations; the first that matches counts."""

NUMBERS = NUMBER_WORDS | {str(number): number for number in NUMBER_WORDS.values()}
HOME_CLAUSES = (
    r"(?:go|return|move|drive|come|get|travel|retreat|head|finish|end|run|retire|withdraw|park)"
    r"(?: the arm| your arm| yourself| back| up| off| on| straight| over)*(?: to| at| in| into)?(?: the| your| its)?"
    r"(?: home| resting| rest| start| starting| initial| parking)+(?: posture| position| pose| place)?",
    r"(?:retract|park)(?: the| your)? (?:arm|robot)",
    r"(?:go|move|return|fold|tuck|pull|retract|withdraw|come|get)(?: yourself| the arm"
    r"| your arm)?(?: back)?(?: in)? (?:into|to|in) "
    r"(?:the|your|its) (?:(?:home|rest|resting|starting|initial|parking) (?:position|pose|posture|place)"
    r"|(?:position|pose|posture|place) (?:that |where )?you (?:started|began)(?: from| in| at)?)",
    r"go (?:back )?to where you (?:started|began|were)",
    r"go back to where you started",
    r"(?:go|return) (?:and|to) rest",
    r"that is all for today",
    r"(?:get|move)(?: the arm| your arm)? out of (?:the|my) way(?:, back home)?",
    r"the arm should be at rest",
    r"we are done for now, go and rest",
    r"(?:arm )?(?:(?:back|off|straight|on) )*(?:to |in |into )?(?:the |your )?home(?: position| pose"
    r"| posture)?(?: you go)?",
    r"homing(?: move| motion)?",
)
REST_CLAUSES = (r"(?:have a |take a )?(?:rest|break)", r"relax", r"stay at rest")
"""Requests that a robot carries out by standing still as well as by going home."""
WAITING_CLAUSE = (
    r"(?:wait|pause|make a pause|make a break|freeze|rest|hold|stand|stay|stop|keep|remain|do nothing|(?:do not"
    r"|don't) (?:move|budge|stir)|take a break)"
    rf"(?: still| put| there| here| steady| where you are| like that| right there| with (?:it|them)| motionless"
    rf"| quiet| perfectly still)* {DURATION}"
)
STILL_CLAUSES = (
    WAITING_CLAUSE,
    r"stay (?:like (?:that|this)|as you are)",
    r"stop(?: it| now| moving| at once| everything| the arm| the robot)*|halt|freeze|wait(?: there| here)?|pause|"
    r"stay(?: where you are| there| still)*|hold still|stand still|do(?: not|n't) move|do nothing|don't do anything|"
    r"do not do anything|hold(?: on| it)?|stay put|abort|cancel|whoa|enough",
)
