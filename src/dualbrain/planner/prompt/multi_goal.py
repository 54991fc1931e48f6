"""Prompt text for instructions with several goals: an order, all objects of a kind, or a condition.

This text is not part of the fixed template and is only in requests that need it, so that the prompt for a single goal
does not change; it has its own version and hash (`full_prompt.conditional_text_hash`). Rules on the words and the names
in the scene detect the need: small models profit more from one fitting example than from general advice.
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
    """The needs of the instruction of `request` beyond one goal, in a fixed order; () for a single goal."""
    words = request.instruction.lower()
    mentioned = set(re.findall(r"[a-z0-9]+", words))
    objects, places = _names(request, "graspable"), _names(request, "receptive")
    named = sum(set(name.split("_")) <= mentioned for name in objects)
    stops = 0 if objects else sum(set(name.split("_")) <= mentioned for name in places)
    needs: list[PromptNeed] = []
    if (_ORDER.search(words) and (named > 1 or stops > 1)) or (named and _HOME.search(words)):
        needs.append("order")
    if _EVERY.search(words) and any(_is_group_mentioned(name, mentioned) for name in objects):
        needs.append("every")
    if _CONDITION.search(words) and _AVAILABILITY.search(words):
        needs.append("condition")
    return tuple(needs)


def format_rules(needs: Sequence[PromptNeed]) -> str:
    """The rules that precede the scene in the last message; "" for a single goal."""
    return "\n".join((RULES_INTRO, *(f"- {RULES[need]}" for need in needs))) if needs else ""


def select_examples(needs: Sequence[PromptNeed], count: int) -> list[WorkedExample]:
    """At most `count` examples for `needs`, the one for the last need last."""
    fitting = [example for need in needs for example in EXAMPLES[need]]
    return fitting[-count:] if count > 0 else []


def _names(request: PlanRequest, kind: str) -> list[str]:
    lines = (line for line in request.skills_text.splitlines() if line.startswith(f"{kind}:"))
    listed = (name.strip() for line in lines for name in line.partition(":")[2].split(","))
    return [name for name in listed if name not in ("", "nothing")]


def _is_group_mentioned(name: str, words: set[str]) -> bool:
    """Whether `words` contain `name` in the plural, such as "tins", or its colour with "things" or "ones"."""
    parts = name.split("_")
    return f"{parts[-1]}s" in words or (parts[0] in words and bool({"things", "ones", "objects"} & words))


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
