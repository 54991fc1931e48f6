"""Instructions with several goals: this before that, all of a colour, this if that. What the prompt says to them.

It stands beside the unchanging template, in questions that need it only, so that the prompt of a single goal stays
what it was; it has a version and a hash of its own (`prompt.beside_hash`). What is needed is found by rule from the
words and the names in the scene: small models do better with one fitting example than with general advice.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Literal

from dualbrain.planner.prompt.arm_examples import WorkedExample, grasp_action, place_action, table_scene
from dualbrain.planner.request import PlanRequest

MULTI_GOAL_VERSION = 1
PromptNeed = Literal["order", "every", "condition"]

RULES: dict[PromptNeed, str] = {
    "order": "several things are asked for: do each of them, in the order asked for ('before X, Y' means Y first).",
    "every": "all of a colour or kind: every object of the scene that fits, each grasped and placed, and no other.",
    "condition": "a container that holds something is not free; do only the part whose condition is true here.",
}
RULES_INTRO = "This instruction needs care; answer with one contract of at most 8 actions:"

_ORDER = re.compile(r"\b(then|after|afterwards?|before|first|finally|once|when|order)\b")
_EVERY = re.compile(r"\b(all|every|each|both|single one|no|collect)\b")
_CONDITION = re.compile(r"\b(if|unless|otherwise|else|as long as|an empty)\b|\bfree\?")
_AVAILABILITY = re.compile(r"\b(free|empty|full|occupied|taken|(?:nothing|something|anything)(?: is)? in)\b")
_HOME = re.compile(r"\b(go home|return to|back to where|retract|resting|it rests|then rest|then get out)\b")


def detect_needs(request: PlanRequest) -> tuple[PromptNeed, ...]:
    """What the instruction of `request` needs beyond one goal, in a fixed order; () for a single goal."""
    words = request.instruction.lower()
    said = set(re.findall(r"[a-z0-9]+", words))
    things, places = _names(request, "graspable"), _names(request, "receptive")
    named = sum(set(name.split("_")) <= said for name in things)
    stops = 0 if things else sum(set(name.split("_")) <= said for name in places)
    found: list[PromptNeed] = []
    if (_ORDER.search(words) and (named > 1 or stops > 1)) or (named and _HOME.search(words)):
        found.append("order")
    if _EVERY.search(words) and any(_is_group_mentioned(name, said) for name in things):
        found.append("every")
    if _CONDITION.search(words) and _AVAILABILITY.search(words):
        found.append("condition")
    return tuple(found)


def format_rules(wanted: Sequence[PromptNeed]) -> str:
    """What stands before the question; "" for a single goal."""
    return "\n".join((RULES_INTRO, *(f"- {RULES[need]}" for need in wanted))) if wanted else ""


def select_examples(wanted: Sequence[PromptNeed], count: int) -> list[WorkedExample]:
    """At most `count` examples of what is needed, the one for the last need last."""
    fitting = [example for need in wanted for example in EXAMPLES[need]]
    return fitting[-count:] if count > 0 else []


def _names(request: PlanRequest, kind: str) -> list[str]:
    lines = (line for line in request.skills_text.splitlines() if line.startswith(f"{kind}:"))
    listed = (name.strip() for line in lines for name in line.partition(":")[2].split(","))
    return [name for name in listed if name not in ("", "nothing")]


def _is_group_mentioned(name: str, said: set[str]) -> bool:
    """Whether the words speak of things like `name` in the plural: "tins", or its colour with "things" or "ones"."""
    parts = name.split("_")
    return f"{parts[-1]}s" in said or (parts[0] in said and bool({"things", "ones", "objects"} & said))


def _scene_summary(*lines: str, tray: str = "container") -> str:
    return table_scene("\n".join(lines)).replace("white_tray: container", f"white_tray: {tray}")


_BAG = "grey_bag: object, free_finger_axis along, path_max_height none"
_JAR = "brown_jar: object, free_finger_axis across, path_max_height none"
_TIN = "ivory_tin: object, free_finger_axis along, path_max_height low"
_MUG = "ivory_mug: object, free_finger_axis along, path_max_height none"

EXAMPLES: dict[PromptNeed, tuple[WorkedExample, ...]] = {
    "order": (
        WorkedExample(
            _scene_summary(_BAG, _JAR),
            "before you bring the brown jar to the front of the shelf, move the grey bag to the tray",
            (
                grasp_action("grey_bag"),
                place_action("white_tray"),
                grasp_action("brown_jar", finger_axis="across"),
                place_action("shelf_front"),
            ),
        ),
    ),
    "every": (
        WorkedExample(
            _scene_summary(_TIN, _JAR, _MUG),
            "collect all the ivory things on the tray",
            (
                grasp_action("ivory_tin"),
                place_action("white_tray"),
                grasp_action("ivory_mug"),
                place_action("white_tray"),
            ),
        ),
    ),
    "condition": (
        WorkedExample(
            _scene_summary(_BAG, _MUG, tray="container, holds ivory_mug"),
            "the grey bag goes on the tray if the tray is free, otherwise to the front of the shelf",
            (grasp_action("grey_bag"), place_action("shelf_front")),
        ),
        WorkedExample(
            _scene_summary(_JAR, _MUG),
            "if the tray is empty the brown jar belongs on it, else at the back of the shelf",
            (grasp_action("brown_jar", finger_axis="across"), place_action("white_tray")),
        ),
    ),
}
