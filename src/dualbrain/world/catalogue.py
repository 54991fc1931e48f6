"""Which scene a person means: a number, a family with a seed, or a file."""

from __future__ import annotations

from pathlib import Path

from dualbrain.errors import InvalidSetup, UnknownName
from dualbrain.world.scene_spec import SceneSpec, load_scene
from dualbrain.world.scenes import ALL_FAMILIES, make_scene

HAZARDS = ("forearm", "tabletop", "tall", "shelf")
"""Scene N is of family N mod 4, with seed N: any run of four numbers shows every hazard once."""


def open_scene(choice: str, robot: str = "panda") -> SceneSpec:
    """The scene of `choice` for `robot`: "7", "shelf:7" or a path to a scene file.

    Raises `UnknownName`, or `InvalidSetup` where a file is no scene or one of another robot.
    """
    if choice.isdecimal():
        return make_scene(HAZARDS[int(choice) % len(HAZARDS)], int(choice), robot)
    family, _, seed = choice.partition(":")
    if family in ALL_FAMILIES and (seed.isdecimal() or not seed):
        return make_scene(family, int(seed or 0), robot)
    path = Path(choice)
    if path.suffix == ".json" or path.exists():
        return _of(robot, load_scene(path), path)
    if choice.replace(":", "").replace("_", "").isalnum():
        owner = "the catalogue (a number or a scene file also works)"
        raise UnknownName("scene", family, tuple(ALL_FAMILIES), owner=owner)
    allowed = f"a number, FAMILY:SEED with one of {', '.join(ALL_FAMILIES)}, or a scene file (.json)"
    raise InvalidSetup("scene", got=choice, allowed=allowed)


def _of(robot: str, spec: SceneSpec, path: Path) -> SceneSpec:
    if spec.robot != robot:
        raise InvalidSetup(
            "robot of the scene file", got=spec.robot, allowed=robot, fix=f"--robot {spec.robot}. {path}"
        )
    return spec
