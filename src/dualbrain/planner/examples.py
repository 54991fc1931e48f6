"""Three worked examples that stand in for memory while it is empty.

They show the form of a contract and parameters that suit their scenes; their things appear in no scene of the world.
"""

from __future__ import annotations

from typing import Any, NamedTuple


class WorkedExample(NamedTuple):
    """A scene summary, an instruction and the action sequence that answers it."""

    scene: str
    instruction: str
    actions: tuple[dict[str, Any], ...]


def _grasp(name: str, **changed: Any) -> dict[str, Any]:
    params = {"object": name, "speed": 0.2, "clearance": 0.15, "finger_axis": "along", "opening": 0.08}
    params |= {"approach": "top", "wait": "none", "force": 15}
    return {"skill": "grasp", "params": params | changed}


def _place(destination: str, **changed: Any) -> dict[str, Any]:
    params = {"destination": destination, "speed": 0.2, "clearance": 0.15, "route": "direct", "wait": "none"}
    return {"skill": "place", "params": params | changed}


WORKED_EXAMPLES = (
    WorkedExample(
        scene=(
            "robot panda; holding nothing\n"
            "brown_jar: object, neighbour_on_finger_axis none, neighbour_across none, near_edge no\n"
            "white_tray: container\n"
            "person: none\n"
            "places: shelf_front, shelf_back"
        ),
        instruction="put the purple cup on the tray",
        actions=({"skill": "decline", "params": {"reason": "there is no purple cup in the scene"}},),
    ),
    WorkedExample(
        scene=(
            "robot panda; holding nothing\n"
            "grey_box: object, neighbour_on_finger_axis none, neighbour_across tall 3-6cm, near_edge no\n"
            "brown_jar: object, neighbour_on_finger_axis low 3-6cm, neighbour_across none, near_edge no\n"
            "white_tray: container\n"
            "path grey_box to white_tray: path_max_height low, path_blocked_direct no, overhead none\n"
            "path brown_jar to shelf_front: path_max_height tall, path_blocked_direct yes, overhead none\n"
            "person: none\n"
            "places: shelf_front, shelf_back"
        ),
        instruction="move the grey case to the tray and the brown jar to the front of the shelf",
        actions=(
            _grasp("grey_box"),
            _place("white_tray"),
            _grasp("brown_jar", finger_axis="across"),
            _place("shelf_front", clearance=0.2, route="near_base"),
        ),
    ),
    WorkedExample(
        scene=(
            "robot panda; holding nothing\n"
            "orange_tin: object, neighbour_on_finger_axis none, neighbour_across low 3-6cm, near_edge no\n"
            "white_tray: container\n"
            "path orange_tin to white_tray: path_max_height low, path_blocked_direct yes, overhead none\n"
            "person: crossing\n"
            "places: shelf_front"
        ),
        instruction="put the orange can on the tray, then go home",
        actions=(
            _grasp("orange_tin", wait="until_clear"),
            _place("white_tray", route="near_base", wait="until_clear"),
            {"skill": "home", "params": {"speed": 0.2}},
        ),
    ),
)
