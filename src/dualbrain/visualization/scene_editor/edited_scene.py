"""A scene as the editor's page sends it, and its conversion to and from a scene specification."""

from __future__ import annotations

from math import cos, pi, sin
from typing import Annotated, Any

import msgspec

from dualbrain.core.geometry.shapes import Bowl, Box, Cylinder, Shape
from dualbrain.errors import DECODE_ERRORS, ConfigurationError
from dualbrain.records import Role
from dualbrain.simulation.scenes.arrangement import arrangement_problems, footprint, yaw_of
from dualbrain.simulation.scenes.colours import COLOUR_RGBA
from dualbrain.simulation.scenes.scene_spec import TABLE_X, TABLE_Y, MovingPerson, ObjectSpec, SceneSpec, check_scene

MAX_OBJECTS = 40
OBJECT_KINDS: dict[str, tuple[Role, Shape, float]] = {
    "cube": ("object", Box((0.02, 0.02, 0.025)), 0.08),
    "block": ("object", Box((0.025, 0.025, 0.025)), 0.10),
    "carton": ("object", Box((0.025, 0.02, 0.05)), 0.12),
    "tin": ("object", Cylinder(0.028, 0.026), 0.10),
    "can": ("object", Cylinder(0.028, 0.05), 0.15),
    "bottle": ("object", Cylinder(0.03, 0.10), 0.25),
    "bowl": ("container", Bowl(radius=0.085, height=0.05, wall=0.004), 0.35),
    "pillar": ("obstacle", Box((0.03, 0.03, 0.15)), 2.0),
}
"""Kinds of objects that the page can add: role, shape and mass [kg]."""
FOREARM = MovingPerson(start=(0.75, -0.6, 0.2), end=(0.75, 0.6, 0.2), speed=0.15, pause=3.0, phase=0.0)
"""The person that the page can add: a forearm that crosses the table."""

Number = Annotated[float, msgspec.Meta(ge=-2.0, le=2.0)]
Angle = Annotated[float, msgspec.Meta(ge=-2 * pi, le=2 * pi)]


class EditedObject(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """An object of the page at (x, y) [m], turned by `yaw` [rad].

    `source` is the object of the original scene that it was, "" for a new one of `kind`.
    """

    name: Annotated[str, msgspec.Meta(max_length=48)]
    kind: str
    colour: str
    x: Number
    y: Number
    yaw: Angle
    source: str = ""


class EditedScene(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """All objects of the page, and whether a person's forearm crosses the table."""

    objects: Annotated[tuple[EditedObject, ...], msgspec.Meta(max_length=MAX_OBJECTS)]
    person: bool = False


def page_data(spec: SceneSpec) -> dict[str, Any]:
    """What the page draws: table, places, kinds, colours, and the objects of `spec` with their outlines."""
    outlines = {kind: footprint(shape, (0.0, 0.0), 0.0) for kind, (_, shape, _) in OBJECT_KINDS.items()}
    objects = [
        {
            "name": obj.name,
            "kind": obj.category,
            "colour": obj.colour,
            "x": obj.position[0],
            "y": obj.position[1],
            "yaw": yaw_of(obj),
            "source": obj.name,
            "outline": footprint(obj.shape, (0.0, 0.0), 0.0),
        }
        for obj in spec.objects
    ]
    return {
        "table": {"x": TABLE_X, "y": TABLE_Y},
        "places": [{"name": one.name, "x": one.position[0], "y": one.position[1]} for one in spec.places],
        "colours": {name: _hexadecimal(rgba) for name, rgba in COLOUR_RGBA.items()},
        "kinds": outlines,
        "objects": objects,
        "person": spec.mover is not None,
    }


def _hexadecimal(rgba: tuple[float, float, float, float]) -> str:
    return "#" + "".join(f"{round(255 * part):02x}" for part in rgba[:3])


def read_edited_scene(content: bytes, original: SceneSpec) -> tuple[SceneSpec | None, list[str]]:
    """The scene that the page sent, and its problems in words; None if it cannot be a scene."""
    try:
        edited = msgspec.json.decode(content, type=EditedScene)
        spec = _make_scene(edited, original)
        check_scene(spec)
    except DECODE_ERRORS as error:
        return None, [f"The scene cannot be read: {error}."]
    except ConfigurationError as error:
        return None, [str(error)]
    return spec, arrangement_problems(spec)


def _make_scene(edited: EditedScene, original: SceneSpec) -> SceneSpec:
    mover = (original.mover or FOREARM) if edited.person else None
    objects = tuple(_make_object(one, original) for one in edited.objects)
    return msgspec.structs.replace(original, family="edited", objects=objects, mover=mover)


def _make_object(one: EditedObject, original: SceneSpec) -> ObjectSpec:
    before = next((obj for obj in original.objects if obj.name == one.source), None)
    if before is None:
        before = _new_object(one)
    moved = (one.x, one.y, before.position[2])
    quaternion = (cos(0.5 * one.yaw), 0.0, 0.0, sin(0.5 * one.yaw)) if one.yaw != yaw_of(before) else before.quaternion
    return msgspec.structs.replace(before, name=one.name, colour=one.colour, position=moved, quaternion=quaternion)


def _new_object(one: EditedObject) -> ObjectSpec:
    if one.kind not in OBJECT_KINDS:
        raise ConfigurationError("kind of object", got=one.kind[:48], allowed=", ".join(OBJECT_KINDS))
    role, shape, mass = OBJECT_KINDS[one.kind]
    match shape:
        case Box(half_extents=(_, _, half)) | Cylinder(half_height=half):
            height = half
        case _:  # a bowl is at the height of its bottom
            height = 0.0
    return ObjectSpec(
        name=one.name,
        role=role,
        shape=shape,
        position=(one.x, one.y, height),
        mass=mass,
        colour=one.colour,
        category=one.kind,
        fixed=role == "obstacle",
    )
