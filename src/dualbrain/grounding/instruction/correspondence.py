"""Whether a contract is about the words of its instruction: what it moves and where must have been named.

The check is local and independent of the planner. It does not decide whether a contract fulfils the instruction; it
rejects contracts about objects, places or motions that the instruction does not mention.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from dualbrain.contracts.contract import Action, Contract
from dualbrain.contracts.verdict import Rejected
from dualbrain.grounding.instruction.names import (
    CATEGORY_SYNONYMS,
    COLORS,
    Mention,
    category_of,
    color_of,
    find_mentions,
    mask_places,
    name_words,
)
from dualbrain.grounding.instruction.words import normalise

INSTRUCTION_POINTER = "/instruction"
"""The pointer of a rejection by this check; no contract has a field of this name."""
_EVERYTHING = re.compile(
    r"\b(?:everything|all of (?:it|them)|all (?:the )?(?:things|objects|stuff|items)|the rest|the others"
    r"|whatever(?! else| you| i\b)|(?:clear|tidy|clean|empty|sort)(?: up| off| out| away)?(?: (?:the|my|this|your))? ?"
    r"(?:table|desk|bench|mess|place)|(?:clear|tidy|clean|empty|sort)(?:ing)? (?:up|off|out|away)"
    r"|(?:tidy|clean)(?= [.,;!?]|$))\b"
)
"""Words for all objects of a scene; "the clear glass" and "the empty hand" are none."""
_PRONOUN = re.compile(
    r"\b(?:pick|take|grasp|grab|lift|put|place|push|move|drop|hold|get|set|bring|carry|slide|shove"
    r"|nudge|raise|look at|above"
    r"|over|grip|lower|store|stow|collect|tidy|transfer|shift|leave|lay|stand)\b[^.;!?]{0,20}"
    r"\b(?:it|this|that|one|thing|object|item|them)\b"
)
_HOME = re.compile(
    r"\b(?:home|rest|rests|resting|retract|retreat|started|starting|initial|start (?:position|pose"
    r"|posture)|out of the way|break"
    r"|done|finished|today|sleep|park|fold|posture|withdraw|arm (?:back|away)|nobody needs"
    r"|nothing left|move away|go away|back up"
    r"|step back|pull back|move back|leave|retire|neutral|default|base position|ready position"
    r"|safe position|clear of)\b"
)
_RELEASE = re.compile(
    r"\b(?:release|let (?:it |go|the)|drop|open|free|put|place|set|lay|lower|let|leave|deposit|unhand"
    r"|ungrip|loosen|give)\b"
)
_COLORED = re.compile(
    r"\b(?:whatever|everything|anything|nothing|all|all that|what)(?: that)?(?: is| are)? ([a-z]{1,20})\b"
)
"""A color that names all objects that have it: "everything that is yellow"."""
_STAYING = re.compile(
    r"\b(?:hover|hovering|look|watch|inspect|peek|point at|point to|hold|lift|raise|pick up|grasp|grab"
    r"|(?:hand|gripper|fingers|arm) (?:right |just |straight )?(?:above|over))\b"
)
"""Words for a motion after which the object is where it was, or in the hand."""
_PLACEMENT = re.compile(
    r"\b(?:put|puts|putting|plac\w{1,4}|sets?|setting|lay|stand|drop\w{0,4}|deposit\w{0,3}|lower|stor\w{1,3}|stow\w{0,3}"
    r"|stash|tidy|clear\w{0,3}|clean\w{0,3}|sort\w{0,3}|collect|gather|pack|load|return|transfer|move|moved|shift|relocat\w{1,3}"
    r"|remov\w{1,3}|rid|bring|carr\w{1,4}|transport|stack|insert|dump|pop|plonk|stick|throw|toss|bin|away|back|down|belongs?"
    r"|leave|release|let|empty|out of|off|from|a home|in (?:my|the|our|your) way)\b"
)
"""Words for a placement."""
_OPEN_HAND = re.compile(
    r"\b(?:bring|move|put|place|hold) (?:your|the) (?:empty |free |open )?(?:hand|gripper|fingers|arm)\b"
)
"""The hand itself is moved, and no object is placed."""
_TURN = re.compile(r"\b(?:turn|face|heading|rotate|spin|look|point|orient|swivel|rad|degrees|towards?)\b")
_NUMBER = re.compile(r"\d")
_PLACE_PHRASE = re.compile(
    r"\b(?:in|into|inside|on|onto|at|to|towards|upon) (?:the|an?|my|your|that|this|his|her|our) ((?:\w+ ){0,3}?\w+)"
    r"(?= (?:and|then|please|with|by|for|so|but|before|after|now|which|where|from|of|carefully|gently"
    r"|slowly|quickly|,|;|\.|!|\?|:)|$| [,;.!?:])"
)
_HARMLESS_PLACES = frozenset(
    [
        "table",
        "desk",
        "bench",
        "way",
        "home",
        "place",
        "position",
        "posture",
        "pose",
        "side",
        "left",
        "right",
        "top",
        "bottom",
        "front",
        "back",
        "middle",
        "end",
        "air",
        "hand",
        "hands",
        "gripper",
        "grip",
        "fingers",
        "arm",
        "moment",
        "minute",
        "second",
        "time",
        "order",
        "day",
        "list",
        "person",
        "guests",
        "step",
        "steps",
        "robot",
        "rest",
        "same",
        "surface",
        "inside",
        "outside",
        "center",
        "direction",
        "others",
        "other",
        "object",
        "thing",
        "one",
        "ones",
        "things",
        "resting",
        "least",
        "most",
        "spot",
        "room",
        "container",
        "job",
        "task",
        "ground",
        "mess",
        "noise",
        "point",
        "work",
        "morning",
        "evening",
        "afternoon",
        "meantime",
        "list",
        "going",
        "first",
        "last",
        "floor",
    ]
)
_ARM_TARGETS = {"grasp": "object", "push": "object", "move_to": "target"}
_ARM_SKILLS = frozenset({"grasp", "place", "push", "move_to", "release"})


@dataclass(frozen=True, slots=True)
class SceneVocabulary:
    """The names that an instruction may mention: what the hand can take, where things can go, and what it holds."""

    graspable: tuple[str, ...]
    receptive: tuple[str, ...]
    holding: str | None = None


def find_mismatch(contract: Contract, instruction: str, scene: SceneVocabulary) -> Rejected | None:
    """The rejection of a contract about something that `instruction` does not mention; None for all others.

    The hint is a question to the person. Declining, waiting and stopping never need a mention.
    """
    reader = _Reader(instruction, scene)
    for action in contract.action_sequence:
        problem = reader.problem_of(action, contract.action_sequence)
        if problem is not None:
            return problem
    return None


class _Reader:
    """The mentions of one instruction."""

    def __init__(self, instruction: str, scene: SceneVocabulary) -> None:
        self._scene = scene
        self._text = normalise(instruction).text
        self._masked = mask_places(self._text, scene.receptive)
        mentions = find_mentions(self._text, (*scene.graspable, *scene.receptive))
        self._objects = _restricted(mentions, scene.graspable)
        self._places = [one for one in _restricted(mentions, scene.receptive) if not one.source]

    def problem_of(self, action: Action, actions: Sequence[Action]) -> Rejected | None:
        """The rejection of one action of a contract."""
        match action.skill:
            case "grasp" | "push" | "move_to":
                problem = self._target_problem(action)
            case "place":
                problem = self._placement_problem(str(action.params.get("destination", "")))
            case "drive_to" | "drive_to_pose":
                problem = self._drive_problem(action, actions)
            case "home":
                problem = None if _HOME.search(self._text) else _unasked("home", "go to its home posture")
            case "release":
                asked = _RELEASE.search(self._text) or self._objects
                problem = None if asked else _unasked("release", "open its hand")
            case "turn_to":
                asked = _TURN.search(self._text) or len(actions) > 1
                problem = None if asked else _unasked("turn_to", "turn")
            case _:
                problem = None
        return problem

    def _target_problem(self, action: Action) -> Rejected | None:
        """The rejection of a skill with a target of the arm: an object, or for `move_to` also a place."""
        name = str(action.params.get(_ARM_TARGETS[action.skill], ""))
        if name in self._scene.graspable:
            problem = self._object_problem(name)
        else:
            problem = self._place_problem(name, required=True)
        if problem is None and action.skill == "push":
            problem = self._place_problem(str(action.params.get("destination", "")))
        return problem

    def _placement_problem(self, name: str) -> Rejected | None:
        """The rejection of a placement in an instruction that only asks to look at or to hold something."""
        stays = _STAYING.search(self._text) and not _PLACEMENT.search(_OPEN_HAND.sub(" ", self._text))
        return _unasked("place", "put anything down") if stays and not self._places else self._place_problem(name)

    def _object_problem(self, name: str) -> Rejected | None:
        if _EVERYTHING.search(self._text) and not self._objects:
            return None if self._has_stated_color(name) else _question(name, self._scene.graspable, _not_named(name))
        for mention in self._objects:
            if name in mention.names and (mention.several or len(mention.names) == 1):
                return None
        unclear = next((mention for mention in self._objects if name in mention.names), None)
        if unclear is not None:
            return _question(name, unclear.names, f"{_listed(unclear.names)} fit the words")
        if name == self._scene.holding or (len(self._scene.graspable) == 1 and _PRONOUN.search(self._text)):
            return None if not self._objects else _question(name, self._scene.graspable, _not_named(name))
        if _EVERYTHING.search(self._text):
            return None
        return _question(name, self._scene.graspable, _not_named(name))

    def _has_stated_color(self, name: str) -> bool:
        """Whether the object `name` has the color that names all objects that have it; true without one."""
        stated = {color for match in _COLORED.finditer(self._text) if (color := color_of(match[1]))}
        return not stated or not stated.isdisjoint(map(color_of, name_words(name)))

    def _place_problem(self, name: str, *, required: bool = False) -> Rejected | None:
        if name not in self._scene.receptive or any(name in mention.names for mention in self._places):
            return None  # the gate rejects names that are not in the scene
        if self._places or required:
            return _question(name, self._scene.receptive, _not_named(name))
        unknown = self._unknown_place()
        if unknown:
            return _question(name, self._scene.receptive, f"the robot does not know {unknown!r}")
        return None

    def _unknown_place(self) -> str:
        """The place that the words name and the scene does not have; "" if there is none."""
        known = {word for name in self._scene.receptive for word in _words_for(name)}
        colors = {word for name in self._scene.receptive for word in name_words(name)} & COLORS
        for match in _PLACE_PHRASE.finditer(self._masked):
            *others, head = match[1].split()
            if head in _HARMLESS_PLACES or head.startswith("nn"):
                continue
            if head not in known or (set(others) & COLORS) - colors:
                return match[1]
        return ""

    def _drive_problem(self, action: Action, actions: Sequence[Action]) -> Rejected | None:
        if any(other.skill in _ARM_SKILLS for other in actions):
            return None  # the base brings the arm within reach of the objects, which are checked
        if action.skill == "drive_to":
            return self._place_problem(str(action.params.get("place", "")), required=True)
        numbers = len(_NUMBER.findall(self._text)) > 1
        return None if numbers else _question("drive_to_pose", self._scene.receptive, "the words state no position")


def _restricted(mentions: Sequence[Mention], names: Sequence[str]) -> list[Mention]:
    """The mentions with their names among `names`."""
    found = (Mention(tuple(name for name in one.names if name in names), one.several, one.source) for one in mentions)
    return [one for one in found if one.names]


def _words_for(name: str) -> set[str]:
    category = category_of(name)
    return {category, *CATEGORY_SYNONYMS.get(category, ()), *name.split("_")}


def _not_named(name: str) -> str:
    return f"the instruction does not name {_listed((name,))}"


def _listed(names: Sequence[str]) -> str:
    words = [f"the {name.replace('_', ' ')}" for name in names]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def _question(got: str, names: Sequence[str], because: str) -> Rejected:
    choices = [name.replace("_", " ") for name in names]
    listed = f" {', '.join(choices[:-1])} or {choices[-1]}?" if len(choices) > 1 else f" {''.join(choices) or 'none'}?"
    return Rejected(
        stage="envelope",
        pointer=INSTRUCTION_POINTER,
        got=got,
        allowed=list(names),
        hint=f"{because}; which one do you mean:{listed}",
    )


def _unasked(skill: str, motion: str) -> Rejected:
    return Rejected(
        stage="envelope",
        pointer=INSTRUCTION_POINTER,
        got=skill,
        allowed="skills that the instruction asks for",
        hint=f"the instruction does not ask the robot to {motion}: leave {skill} out",
    )
