"""A map's values where the robot can use them: places in the scene, and what a base may drive on of its floor."""

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
"""A place counts as on the table, or on the floor, if its height is within this of it [m]."""
FRAME_HINT = (
    "Name the frame whose origin and x axis are those of the base at its start, as MAP:FRAME, or correct the map."
)


def apply_map(spec: SceneSpec, robot_model: RobotModel, library: Library, map_ref: str) -> SceneSpec:
    """The scene as `body` knows it from the map that `where` names: with its places, and for a base with its floor."""
    chart, frame = load_map(library, map_ref)
    return (
        with_floor(spec, chart, frame, robot_model)
        if robot_model.is_mobile and spec.region
        else with_places(spec, chart, frame)
    )


def load_map(library: Library, map_ref: str) -> tuple[RoomMap, str]:
    """Map and frame that `where` names: "room-map:panda_table", or "room-map" for the map's own frame.

    Raises `UnknownName` for a document that is not there, `InvalidSetup` for one that is no map, or whose source is not
    trusted: a found map must not move the walls.
    """
    name, _, frame = map_ref.partition(":")
    document = library.document(name)
    if document.kind != "map" or document.trust == "unknown":
        got, allowed = f"{document.kind}, trust {document.trust}", "a map that is trusted"
        raise ConfigurationError(f"map {name!r}", got=got, allowed=allowed, fix="See `dualbrain knowledge list`.")
    found = parse_structured(library.document_text(name), RoomMap)
    if isinstance(found, DocumentRejected):  # it was sound when it was added
        raise ConfigurationError(f"map {name!r}", got=str(found), allowed="a sound map")
    return found, frame or found.frame


def with_places(spec: SceneSpec, chart: RoomMap, frame: str) -> SceneSpec:
    """The scene with the map's places that lie on its table, seen from `frame`, which must be the scene's own.

    Places of the scene keep their names: one of the map that is called like anything in the scene is left out, because
    what was measured here and now is newer than a map. Raises `UnknownName` for a frame that the map does not know.
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
    """The room with the map's places on its floor, and with what the map leaves of that floor to `body`.

    Names are the scene's own as in `with_places`. Raises `InvalidSetup` if the base does not start on the map's floor
    with room around it, or if one of those places lies off that floor: nobody could drive there, or should.
    """
    start = home_state(robot_model).q[:2]
    known = msgspec.structs.replace(
        spec, chart=drivable_floor(chart, frame, (float(start[0]), float(start[1])), spec.region)
    )
    new = tuple(place for place in _new_places(spec, chart, frame) if abs(place.position[2]) <= HEIGHT_TOLERANCE)
    known = msgspec.structs.replace(known, places=(*spec.places, *new))
    check_scene(known)
    drawn = Scene(robot=spec.robot, stamp=0.0, version=1, objects=keep_out_objects(known, 0.0), region=known.floor)
    room = float(clearance(drawn, start))
    footprint = max(float(np.hypot(*ball.centre[:2])) + ball.radius for ball in extract_base(robot_model).spheres)
    if room < footprint:
        raise ConfigurationError(
            f"start of the base, {room:.2f} m inside the map's floor",
            got=start.tolist(),
            allowed=f"its footprint on the floor: {footprint:.2f} m or more",
            fix=FRAME_HINT,
        )
    off = [place for place in new if float(clearance(drawn, np.array(place.position[:2]))) < 0.0]
    if off:
        raise ConfigurationError(
            f"place {off[0].name!r} of the map",
            got=tuple(round(value, 3) for value in off[0].position[:2]),
            allowed="on the floor that map and room both leave to the base, outside of what the map closes",
            fix=FRAME_HINT,
        )
    return known


def drivable_floor(chart: RoomMap, frame: str, at: Point, room: tuple[Point, ...]) -> FloorMap:
    """What the map leaves to a base at `at` (x, y) [m] of `frame` in a `room` with convex walls.

    The floor is the room's and that of the first traversable region that holds `at`, what both have in common: the
    union of several regions is no barrier that a filter could keep, and the intersection of them all would shut doors.
    Every keep_out region becomes the smallest rectangle around it. A map without traversable regions bounds nothing.
    Raises `InvalidSetup` if there are some and `at` lies in none.
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
    """The map's places whose names the scene does not have."""
    taken = {one.name for one in (*spec.objects, *spec.places)} | ({spec.mover.name} if spec.mover else set[str]())
    return tuple(place for place in chart.scene_places(frame) if place.name not in taken)


def _bounding_rectangle(name: str, corners: tuple[Point, ...]) -> KeepOutArea:
    """The smallest rectangle around a convex polygon; one of its sides lies on one of the polygon's (Freeman, 1975)."""
    turns = [atan2(by - ay, bx - ax) for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True)]
    boxes = [_oriented_box(corners, turn) for turn in turns]
    x, y, half_x, half_y, yaw = min(boxes, key=lambda box: box[2] * box[3])
    return KeepOutArea(name, (x, y), (half_x, half_y), yaw)


def _oriented_box(corners: tuple[Point, ...], yaw: float) -> tuple[float, float, float, float, float]:
    """Centre and half sides [m] of the rectangle around `corners` whose x axis is turned by `yaw`."""
    c, s = cos(yaw), sin(yaw)
    along = [c * x + s * y for x, y in corners]
    across = [c * y - s * x for x, y in corners]
    u, v = (max(along) + min(along)) / 2, (max(across) + min(across)) / 2
    return c * u - s * v, s * u + c * v, (max(along) - min(along)) / 2, (max(across) - min(across)) / 2, yaw
