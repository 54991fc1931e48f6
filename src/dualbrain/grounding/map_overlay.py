"""Adds a map to a scene: its places, and for a mobile base the floor that it may drive on."""

from __future__ import annotations

from math import atan2, cos, sin

import msgspec
import numpy as np

from dualbrain.core.geometry.polygons import intersect_convex
from dualbrain.errors import ConfigurationError
from dualbrain.knowledge.library import Library
from dualbrain.knowledge.rejection import DocumentRejected
from dualbrain.knowledge.structured.maps import Point, RoomMap, is_inside_polygon
from dualbrain.knowledge.structured.parsing import parse_structured
from dualbrain.records import Place, Scene
from dualbrain.robots.interface import home_state
from dualbrain.robots.mobile_manipulator import extract_base
from dualbrain.robots.model import RobotModel
from dualbrain.simulation.scenes.scene_spec import (
    TABLE_X,
    TABLE_Y,
    FloorMap,
    KeepOutArea,
    SceneSpec,
    check_scene,
    keep_out_objects,
)
from dualbrain.skills.mobile_base.path_planning import clearance

HEIGHT_TOLERANCE = 0.01
"""A place is on the table or on the floor if its height differs by at most this [m]."""
FRAME_HINT = (
    "Name the frame whose origin and x axis are those of the base at its start, as MAP:FRAME, or correct the map."
)


def apply_map(spec: SceneSpec, robot_model: RobotModel, library: Library, map_ref: str) -> SceneSpec:
    """The scene with the places of the map `map_ref`, and for a mobile base in a room also with its floor.

    Raises as `load_map`, `with_places` and `with_floor`.
    """
    chart, frame = load_map(library, map_ref)
    return (
        with_floor(spec, chart, frame, robot_model)
        if robot_model.is_mobile and spec.region
        else with_places(spec, chart, frame)
    )


def load_map(library: Library, map_ref: str) -> tuple[RoomMap, str]:
    """The map and the frame of `map_ref`, such as "room-map:panda_table", or "room-map" for the map's own frame.

    Raises `UnknownNameError` for an unknown document, and `ConfigurationError` for a document that is not a map or has
    an untrusted source, which must not change the floor of a robot.
    """
    name, _, frame = map_ref.partition(":")
    document = library.document(name)
    if document.kind != "map" or document.trust == "unknown":
        sentence = f"Document {name!r} is of kind {document.kind} with trust {document.trust}, not a trusted map."
        raise ConfigurationError.stating(sentence, fix="List the documents with `dualbrain knowledge list`.")
    found = parse_structured(library.document_text(name), RoomMap)
    if isinstance(found, DocumentRejected):  # the map was valid when it was added
        sentence = f"Map {name!r} is invalid: {found}."
        raise ConfigurationError.stating(sentence, fix="Correct the map and add it again.")
    return found, frame or found.frame


def with_places(spec: SceneSpec, chart: RoomMap, frame: str) -> SceneSpec:
    """The scene with the places of the map that are on its table, in `frame`, which must be the frame of the scene.

    A place of the map is left out if its name is already used in the scene, because the measured scene is newer than a
    map. Raises `UnknownNameError` for a frame that the map does not define.
    """
    new = tuple(
        place
        for place in _new_places(spec, chart, frame)
        if TABLE_X[0] <= place.position[0] <= TABLE_X[1]
        and TABLE_Y[0] <= place.position[1] <= TABLE_Y[1]
        and abs(place.position[2]) <= HEIGHT_TOLERANCE
    )
    known = msgspec.structs.replace(spec, places=(*spec.places, *new))
    check_scene(known)
    return known


def with_floor(spec: SceneSpec, chart: RoomMap, frame: str, robot_model: RobotModel) -> SceneSpec:
    """The room with the places of the map on its floor, and with the part of the floor that the map permits.

    Names that the scene already uses are left out, as in `with_places`. Raises `ConfigurationError` if the footprint of
    the base at its start is not on the floor of the map, or if one of the new places is outside that floor; and
    `UnknownNameError` for a frame that the map does not define.
    """
    start = home_state(robot_model).q[:2]
    known = msgspec.structs.replace(
        spec, chart=drivable_floor(chart, frame, (float(start[0]), float(start[1])), spec.region)
    )
    new = tuple(place for place in _new_places(spec, chart, frame) if abs(place.position[2]) <= HEIGHT_TOLERANCE)
    known = msgspec.structs.replace(known, places=(*spec.places, *new))
    check_scene(known)
    floor_scene = Scene(
        robot=spec.robot, stamp=0.0, version=1, objects=keep_out_objects(known, 0.0), region=known.floor
    )
    distance = float(clearance(floor_scene, start))
    footprint = max(float(np.hypot(*sphere.centre[:2])) + sphere.radius for sphere in extract_base(robot_model).spheres)
    if distance < footprint:
        raise ConfigurationError(
            f"start of the base, {distance:.2f} m inside the floor of the map",
            got=start.tolist(),
            allowed=f"a point at least {footprint:.2f} m inside it, the radius of the footprint",
            fix=FRAME_HINT,
        )
    outside = [place for place in new if float(clearance(floor_scene, np.array(place.position[:2]))) < 0.0]
    if outside:
        raise ConfigurationError(
            f"place {outside[0].name!r} of the map",
            got=tuple(round(value, 3) for value in outside[0].position[:2]),
            allowed="a point on the common floor of map and room, outside the keep-out areas",
            fix=FRAME_HINT,
        )
    return known


def drivable_floor(chart: RoomMap, frame: str, at: Point, room: tuple[Point, ...]) -> FloorMap:
    """The floor that a map permits to a base at `at` (x, y) [m] of `frame` in a convex `room`.

    The floor is the intersection of the room and the first traversable region that contains `at`. The union of several
    regions is not convex, so that a barrier cannot represent it; the intersection of all regions would close the
    passages between them. Every keep_out region becomes the smallest rectangle around it. Without traversable regions,
    the floor is that of the room. Raises `ConfigurationError` if there are traversable regions and none contains `at`.
    """
    found = chart.polygons(frame, "traversable")
    around = [corners for _, corners in found if is_inside_polygon(at, corners)]
    if found and not around:
        names = ", ".join(name for name, _ in found)
        raise ConfigurationError(
            "start of the base", got=at, allowed=f"inside a traversable region: {names}", fix=FRAME_HINT
        )
    floor = intersect_convex(around[0], room) if around else room
    return FloorMap(
        floor, tuple(_bounding_rectangle(name, corners) for name, corners in chart.polygons(frame, "keep_out"))
    )


def _new_places(spec: SceneSpec, chart: RoomMap, frame: str) -> tuple[Place, ...]:
    """The places of the map whose names the scene does not use."""
    taken = {one.name for one in (*spec.objects, *spec.places)} | ({spec.mover.name} if spec.mover else set[str]())
    return tuple(place for place in chart.scene_places(frame) if place.name not in taken)


def _bounding_rectangle(name: str, corners: tuple[Point, ...]) -> KeepOutArea:
    """The smallest rectangle around a convex polygon; it shares a side with the polygon (Freeman and Shapira, 1975)."""
    turns = [atan2(by - ay, bx - ax) for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True)]
    boxes = [_oriented_box(corners, turn) for turn in turns]
    x, y, half_x, half_y, yaw = min(boxes, key=lambda box: box[2] * box[3])
    return KeepOutArea(name, (x, y), (half_x, half_y), yaw)


def _oriented_box(corners: tuple[Point, ...], yaw: float) -> tuple[float, float, float, float, float]:
    """The rectangle (x, y, half_x, half_y, yaw) [m, rad] around `corners` whose x axis is turned by `yaw`."""
    c, s = cos(yaw), sin(yaw)
    along = [c * x + s * y for x, y in corners]
    across = [c * y - s * x for x, y in corners]
    u, v = (max(along) + min(along)) / 2, (max(across) + min(across)) / 2
    return c * u - s * v, s * u + c * v, (max(along) - min(along)) / 2, (max(across) - min(across)) / 2, yaw
