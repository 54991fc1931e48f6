"""Which scene a person means: a number, a family with a seed, or a file."""

from __future__ import annotations

from pathlib import Path

from dualbrain.errors import InvalidSetup, UnknownName
from dualbrain.robots.loader import load_body
from dualbrain.simulation.scenes.generators.rooms import ROOMS, make_room
from dualbrain.simulation.scenes.generators.tabletop import EVERY_FAMILY, make_scene
from dualbrain.simulation.scenes.generators.workroom import WORKROOMS, make_workroom
from dualbrain.simulation.scenes.scene_spec import SceneSpec, load_scene

HAZARDS = ("forearm", "tabletop", "tall", "shelf")
"""Scene N is of family N mod 4, with seed N: any run of four numbers shows every hazard once."""
ROOM_HAZARDS = ("empty_room", "boxes", "crossing")
"""The same for a base, N mod 3."""


def open_scene(choice: str, robot: str = "panda") -> SceneSpec:
    """The scene of `choice` for `robot`: "7", "shelf:7" or a path to a scene file.

    Raises `UnknownName`, or `InvalidSetup` where a file is no scene or one of another robot.
    """
    families, hazards = _families(robot)
    if choice.isdecimal():
        return _make(hazards[int(choice) % len(hazards)], int(choice), robot)
    family, _, seed = choice.partition(":")
    if family in families and (seed.isdecimal() or not seed):
        return _make(family, int(seed or 0), robot)
    path = Path(choice)
    if path.suffix == ".json" or path.exists():
        return _of(robot, load_scene(path), path)
    if choice.replace(":", "").replace("_", "").isalnum():
        owner = "the catalogue (a number or a scene file also works)"
        raise UnknownName("scene", family, families, owner=owner)
    allowed = f"a number, FAMILY:SEED with one of {', '.join(families)}, or a scene file (.json)"
    raise InvalidSetup("scene", got=choice, allowed=allowed)


def mobile(robot: str) -> bool:
    """Whether `robot` drives, so that its scenes are rooms."""
    return load_body(robot).mobile


def _families(robot: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Every family that has scenes for `robot`, and those that a bare number goes round."""
    body = load_body(robot)
    if body.carries_arm:
        return (*WORKROOMS, *ROOMS), WORKROOMS
    return (tuple(ROOMS), ROOM_HAZARDS) if body.mobile else (tuple(EVERY_FAMILY), HAZARDS)


def _make(family: str, seed: int, robot: str) -> SceneSpec:
    if family in WORKROOMS:
        return make_workroom(family, seed, robot)
    return (make_room if mobile(robot) else make_scene)(family, seed, robot)


def _of(robot: str, spec: SceneSpec, path: Path) -> SceneSpec:
    if spec.robot != robot:
        raise InvalidSetup(
            "robot of the scene file", got=spec.robot, allowed=robot, fix=f"--robot {spec.robot}. {path}"
        )
    return spec
