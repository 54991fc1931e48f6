"""A scene as a table: each object with its shape, its position and its properties."""

from __future__ import annotations

from math import hypot

from dualbrain.cli.common.console import format_table
from dualbrain.core.geometry.shapes import Bowl, Box, Capsule, Cylinder, HalfSpace, Shape, Sphere
from dualbrain.simulation.scenes.scene_spec import MovingPerson, ObjectSpec, SceneSpec

ROLE_WORDS = {
    "object": "object",
    "container": "container",
    "support": "support",
    "obstacle": "obstacle",
    "person": "person",
}
POSITION_NOTE = (
    "Positions [cm] from the base of the robot: x forward, y to its left, z above the table; centre of the object."
)
ROOM_NOTE = "Positions [cm]: x and y on the floor from the start of the robot, z above the floor; centre of the object."
INSIDE_HEIGHT_M = 0.12
"""Height above the bottom of a container up to which the centre of an object in it is looked for [m]."""


def scene_lines(spec: SceneSpec, *, held: str = "") -> list[str]:
    """The lines of the table, the places and the note on the frame; `held` is the object in the hand."""
    rows = [_object_row(spec, obj, held) for obj in spec.objects]
    if spec.mover is not None:
        rows.append(_person_row(spec.mover))
    places = ", ".join(f"{one.name} ({_point(one.position)})" for one in spec.places)
    return [
        f"{spec.family}:{spec.seed} for {spec.robot}",
        format_table(("name", "kind", "shape [cm]", "position [cm]", "remark"), rows, wrap_columns=("remark",)),
        f"places: {places or 'none'}",
        ROOM_NOTE if spec.region else POSITION_NOTE,
    ]


def _object_row(spec: SceneSpec, obj: ObjectSpec, held: str) -> tuple[str, ...]:
    return (obj.name, ROLE_WORDS[obj.role], _shape_in_words(obj.shape), _point(obj.position), _remark(spec, obj, held))


def _person_row(mover: MovingPerson) -> tuple[str, ...]:
    path = f"moves between ({_point(mover.start)}) and ({_point(mover.end)}) at {mover.speed * 100:.0f} cm/s"
    return (mover.name, "person", _shape_in_words(Capsule(mover.radius, mover.half_length)), _point(mover.start), path)


def _remark(spec: SceneSpec, obj: ObjectSpec, held: str) -> str:
    remarks = [
        "in the hand" if obj.name == held else "",
        "" if obj.name == held else _container_of(spec, obj),
        f"breaks above {obj.fragile_limit:g} N" if obj.fragile_limit is not None else "",
        "fixed" if obj.fixed else "",
    ]
    return ", ".join(filter(None, remarks))


def _container_of(spec: SceneSpec, obj: ObjectSpec) -> str:
    """The container that `obj` is in, as a remark; "" for none."""
    for one in spec.objects:
        if isinstance(one.shape, Bowl) and one.name != obj.name:
            away = hypot(obj.position[0] - one.position[0], obj.position[1] - one.position[1])
            if away < one.shape.radius and 0.0 < obj.position[2] - one.position[2] < INSIDE_HEIGHT_M:
                return f"in {one.name}"
    return ""


def _point(position: tuple[float, ...]) -> str:
    return " ".join(f"{100 * value:5.1f}" for value in position)


def _shape_in_words(shape: Shape) -> str:
    """A shape with its whole lengths in cm."""
    match shape:
        case Box(half_extents=half):
            return "box " + " × ".join(f"{200 * value:.1f}" for value in half)
        case Cylinder(radius=radius, half_height=half):
            return f"cylinder ⌀ {200 * radius:.1f}, height {200 * half:.1f}"
        case Capsule(radius=radius, half_length=half):
            return f"capsule ⌀ {200 * radius:.1f}, length {200 * (half + radius):.1f}"
        case Sphere(radius=radius):
            return f"sphere ⌀ {200 * radius:.1f}"
        case Bowl(radius=radius, height=height):
            return f"bowl ⌀ {200 * radius:.1f}, height {100 * height:.1f}"
        case HalfSpace():
            return "plane"
