"""Opens a scene by number, by family and seed, or from a file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.loader import load_robot
from dualbrain.simulation.scenes.arrangement import arrangement_problems
from dualbrain.simulation.scenes.generators.rooms import ROOM_FAMILIES, make_room
from dualbrain.simulation.scenes.generators.tabletop import SCENE_FAMILIES, make_scene
from dualbrain.simulation.scenes.generators.workroom import WORKROOM_DESCRIPTIONS, WORKROOM_FAMILIES, make_workroom
from dualbrain.simulation.scenes.scene_spec import SceneSpec, load_scene

NUMBERED_FAMILIES = ("forearm", "tabletop", "tall", "shelf")
"""Scene N is of family number N mod 4 with seed N, so that four consecutive numbers cover every hazard."""
NUMBERED_ROOM_FAMILIES = ("empty_room", "boxes", "crossing")
"""The same for a mobile base: scene N is of family number N mod 3."""


def open_scene(choice: str, robot: str = "panda") -> SceneSpec:
    """The scene that `choice` names for `robot`: "7", "shelf:7" or the path of a scene file.

    Raises `UnknownNameError` for an unknown robot or family, and `ConfigurationError` for a file that is not a valid
    scene or belongs to another robot.
    """
    families, numbered = _families_for(robot)
    if choice.isdecimal():
        return _generate_scene(numbered[int(choice) % len(numbered)], int(choice), robot)
    family, _, seed = choice.partition(":")
    if family in families and (seed.isdecimal() or not seed):
        return _generate_scene(family, int(seed or 0), robot)
    path = Path(choice)
    if path.suffix == ".json" or path.exists():
        return require_robot(robot, _load_arranged_scene(path), str(path))
    if family not in families and choice.replace(":", "").replace("_", "").isalnum():
        owner = "the catalogue (a number or a scene file also works)"
        raise UnknownNameError("scene", family, families, owner=owner)
    allowed = f"a number, FAMILY:SEED with one of {', '.join(families)}, or a scene file (.json)"
    raise ConfigurationError("scene", got=choice, allowed=allowed)


@dataclass(frozen=True, slots=True)
class SceneFamily:
    """A scene family: its name, the scene numbers that mean it in words, and its content in one sentence."""

    name: str
    numbers: str
    description: str


def describe_families(robot: str) -> list[SceneFamily]:
    """The families that have scenes for `robot`; raises `UnknownNameError` for an unknown robot."""
    families, numbered = _families_for(robot)
    makers = {**ROOM_FAMILIES, **SCENE_FAMILIES}
    found: list[SceneFamily] = []
    for name in families:
        first = f"{numbered.index(name)}, {numbered.index(name) + len(numbered)}, …" if name in numbered else ""
        text = WORKROOM_DESCRIPTIONS.get(name) or (makers[name].__doc__ or "").splitlines()[0]
        found.append(SceneFamily(name, first, text))
    return found


def is_mobile(robot: str) -> bool:
    """Whether `robot` has a mobile base, so that its scenes are rooms; raises `UnknownNameError`."""
    return load_robot(robot).is_mobile


def _families_for(robot: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The families that have scenes for `robot`, and those that numbered scenes take in turn."""
    robot_model = load_robot(robot)
    if robot_model.is_mobile_manipulator:
        return (*WORKROOM_FAMILIES, *ROOM_FAMILIES), WORKROOM_FAMILIES
    return (
        (tuple(ROOM_FAMILIES), NUMBERED_ROOM_FAMILIES)
        if robot_model.is_mobile
        else (tuple(SCENE_FAMILIES), NUMBERED_FAMILIES)
    )


def _generate_scene(family: str, seed: int, robot: str) -> SceneSpec:
    if family in WORKROOM_FAMILIES:
        return make_workroom(family, seed, robot)
    return (make_room if is_mobile(robot) else make_scene)(family, seed, robot)


def _load_arranged_scene(path: Path) -> SceneSpec:
    """The scene in a file, if its objects are where objects can be."""
    spec = load_scene(path)
    if problems := arrangement_problems(spec):
        sentence = f"The scene file cannot be used. {' '.join(problems)}"
        raise ConfigurationError.stating(sentence, fix=f"Correct the file, or edit it: dualbrain scene new {path}")
    return spec


def require_robot(robot: str, spec: SceneSpec, path: str = "") -> SceneSpec:
    """`spec`, read from the file `path`; raises `ConfigurationError` if it is the scene of another robot."""
    if spec.robot != robot:
        sentence = f"The scene is for robot {spec.robot!r}, not for {robot!r}."
        fix = f"Choose another one, or pass --robot {spec.robot}. {path}".strip()
        raise ConfigurationError.stating(sentence, fix=fix)
    return spec
