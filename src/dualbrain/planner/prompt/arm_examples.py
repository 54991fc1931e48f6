"""Worked examples for an arm: the form of a contract, and parameters that suit a scene.

`full_prompt.ARM_EXAMPLES` are in every prompt. `select_examples` chooses for one request: a small model copies the
parameters of the last example, so the example with the most similar scene comes last. Similarity counts the common
symbols of the object that the instruction names. The objects in the examples are in no scene of the simulation.
"""

from __future__ import annotations

import re
from typing import Any, NamedTuple


class WorkedExample(NamedTuple):
    """A scene summary, an instruction and the action sequence that answers it."""

    scene: str
    instruction: str
    actions: tuple[dict[str, Any], ...]


def grasp_action(name: str, **changed: Any) -> dict[str, Any]:
    """A grasp action with default parameters, some of them `changed`."""
    params = {"object": name, "speed": 0.2, "clearance": 0.15, "finger_axis": "along", "opening": 0.08}
    params |= {"approach": "top", "wait": "none", "force": 15}
    return {"skill": "grasp", "params": params | changed}


def place_action(destination: str, **changed: Any) -> dict[str, Any]:
    """A place action with default parameters, some of them `changed`."""
    params = {"destination": destination, "speed": 0.2, "clearance": 0.15, "route": "direct", "wait": "none"}
    return {"skill": "place", "params": params | changed}


def table_scene(objects: str, person: str = "none", places: str = "shelf_front, shelf_back") -> str:
    """The summary of a table with `objects` and a tray."""
    return f"robot panda; holding nothing\n{objects}\nwhite_tray: container\nperson: {person}\nplaces: {places}"


DECLINE_EXAMPLE = WorkedExample(
    table_scene("brown_jar: object, free_finger_axis along, path_max_height none"),
    "put the purple cup on the tray",
    ({"skill": "decline", "params": {"reason": "there is no purple cup in the scene"}},),
)

LOW_EXAMPLE = WorkedExample(
    table_scene("brown_jar: object, free_finger_axis across, neighbour_along low 3-6cm, path_max_height low"),
    "the brown jar should go on the tray, can you move it there?",
    (grasp_action("brown_jar", finger_axis="across"), place_action("white_tray")),
)
"""Low neighbours along the object: the fingers close across it."""

TIGHT_EXAMPLE = WorkedExample(
    table_scene("brown_jar: object, free_finger_axis across, tight, neighbour_along tall >6cm, path_max_height tall"),
    "could you move that brown jar over to the tray?",
    (
        grasp_action("brown_jar", clearance=0.3, finger_axis="across", approach="tilted"),
        place_action("white_tray", clearance=0.3),
    ),
)
"""A tight object beside a tall one: tilted approach, much clearance."""

FETCH_EXAMPLES = (
    WorkedExample(
        table_scene("grey_bag: object, free_finger_axis along, path_max_height none"),
        "could you move the grey bag over to the tray, please?",
        (grasp_action("grey_bag"), place_action("white_tray")),
    ),
    LOW_EXAMPLE,
    WorkedExample(
        table_scene(
            "beige_mug: object, free_finger_axis along, neighbour_across hand_high 3-6cm, path_max_height hand_high"
        ),
        "please move the beige mug over onto the tray",
        (grasp_action("beige_mug", clearance=0.2), place_action("white_tray", clearance=0.2)),
    ),
    TIGHT_EXAMPLE,
    WorkedExample(
        table_scene("grey_bag: object, free_finger_axis along, neighbour_across tall >6cm, path_max_height tall"),
        "move the grey bag onto the tray",
        (grasp_action("grey_bag", clearance=0.3), place_action("white_tray", clearance=0.3)),
    ),
    WorkedExample(
        table_scene("beige_mug: object, free_finger_axis along, path_max_height low, overhead over_path"),
        "would you move the beige mug over to the tray?",
        (grasp_action("beige_mug", clearance=0.1), place_action("white_tray", clearance=0.1, route="near_base")),
    ),
    WorkedExample(
        table_scene(
            "grey_bag: object, free_finger_axis across, neighbour_along low <3cm, "
            "path_max_height low, overhead over_path"
        ),
        "the grey bag goes on the tray, move it over please",
        (
            grasp_action("grey_bag", clearance=0.1, finger_axis="across"),
            place_action("white_tray", clearance=0.1, route="near_base"),
        ),
    ),
    WorkedExample(
        table_scene(
            "ivory_tin: object, free_finger_axis along, neighbour_across low 3-6cm, path_max_height low", "crossing"
        ),
        "could you move the ivory tin over onto the tray? watch out for my arm",
        (
            grasp_action("ivory_tin", clearance=0.2, wait="until_clear"),
            place_action("white_tray", clearance=0.2, wait="until_clear"),
        ),
    ),
    WorkedExample(
        table_scene(
            "ivory_tin: object, free_finger_axis across, neighbour_along low 3-6cm, path_max_height low", "crossing"
        ),
        "the ivory tin belongs on the tray, please move it over",
        (
            grasp_action("ivory_tin", clearance=0.2, finger_axis="across", wait="until_clear"),
            place_action("white_tray", clearance=0.2, wait="until_clear"),
        ),
    ),
    WorkedExample(
        table_scene(
            "grey_bag: object, free_finger_axis along, path_max_height low\n"
            "brown_jar: object, free_finger_axis across, neighbour_along low 3-6cm, path_max_height none"
        ),
        "move the grey bag to the tray and the brown jar to the front of the shelf, then go home",
        (
            grasp_action("grey_bag"),
            place_action("white_tray"),
            grasp_action("brown_jar", finger_axis="across"),
            place_action("shelf_front"),
            {"skill": "home", "params": {"speed": 0.2}},
        ),
    ),
)

WORKED_EXAMPLES = (DECLINE_EXAMPLE, *FETCH_EXAMPLES)


def select_examples(scene: str, instruction: str, count: int) -> list[WorkedExample]:
    """The `count` examples most similar to `scene` for the object that `instruction` names, the most similar last."""
    wanted = _symbols(scene, instruction)
    ranked = sorted(enumerate(FETCH_EXAMPLES), key=lambda pair: (-_similarity(wanted, pair[1]), pair[0]))
    best = [example for _, example in ranked[: max(0, count - 1)]]
    return [DECLINE_EXAMPLE, *best[::-1]][-count:] if count else []


def _similarity(wanted: frozenset[str], example: WorkedExample) -> float:
    """Jaccard index of the symbols."""
    symbols = _symbols(example.scene, example.instruction)
    return len(wanted & symbols) / max(1, len(wanted | symbols))


def _symbols(scene: str, instruction: str) -> frozenset[str]:
    """The symbols of the named object and of people, and a symbol for an instruction with several objects."""
    words = set(re.findall(r"[a-z]+", instruction.lower()))
    lines = [line for line in scene.splitlines() if ": object" in line]
    named = [line for line in lines if set(line.split(":")[0].split("_")) <= words]
    target = max(lines, key=lambda line: len(set(line.split(":")[0].split("_")) & words), default="")
    symbols = {part.strip() for part in target.partition(": object,")[2].split(",")}
    symbols |= {line for line in scene.splitlines() if line.startswith("person:")}
    return frozenset(symbols | ({"several"} if len(named) > 1 else set()))
