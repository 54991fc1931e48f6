"""A map's values where the robot can use them: places in the scene, regions as barriers of a mobile base."""

from __future__ import annotations

from math import atan2, cos, sin

import msgspec

from dualbrain.errors import InvalidSetup
from dualbrain.knowledge.library import Library
from dualbrain.knowledge.maps import Point, RoomMap, inside
from dualbrain.knowledge.refusal import Refused
from dualbrain.knowledge.structured import structure
from dualbrain.safety.barriers.keep_out import keep_out
from dualbrain.safety.barriers.traversable import traversable
from dualbrain.safety.obstacles import Obstacle
from dualbrain.world.scene_spec import TABLE_X, TABLE_Y, SceneSpec, check_scene

ON_TABLE = 0.01
"""A place counts as on the table if its height is within this of the table top [m]."""


def open_map(library: Library, where: str) -> tuple[RoomMap, str]:
    """Map and frame that `where` names: "room-map:panda_table", or "room-map" for the map's own frame.

    Raises `UnknownName` for a document that is not there, `InvalidSetup` for one that is no map, or whose source is not
    trusted: a found map must not move the walls.
    """
    name, _, frame = where.partition(":")
    document = library.document(name)
    if document.kind != "map" or document.trust == "unknown":
        got, allowed = f"{document.kind}, trust {document.trust}", "a map that is trusted"
        raise InvalidSetup(f"map {name!r}", got=got, allowed=allowed, fix="See `dualbrain knowledge list`.")
    found = structure(library.reading(name), RoomMap)
    if isinstance(found, Refused):  # it was sound when it was added
        raise InvalidSetup(f"map {name!r}", got=str(found), allowed="a sound map")
    return found, frame or found.frame


def with_places(spec: SceneSpec, chart: RoomMap, frame: str) -> SceneSpec:
    """The scene with the map's places that lie on its table, seen from `frame`, which must be the scene's own.

    Places of the scene keep their names: one of the map that is called like anything in the scene is left out, because
    what was measured here and now is newer than a map. Raises `UnknownName` for a frame that the map does not know.
    """
    taken = {one.name for one in (*spec.things, *spec.places)} | ({spec.mover.name} if spec.mover else set[str]())
    new = tuple(
        place
        for place in chart.scene_places(frame)
        if place.name not in taken
        and TABLE_X[0] <= place.position[0] <= TABLE_X[1]
        and TABLE_Y[0] <= place.position[1] <= TABLE_Y[1]
        and abs(place.position[2]) <= ON_TABLE
    )
    charted = msgspec.structs.replace(spec, places=(*spec.places, *new))
    check_scene(charted)
    return charted


def barriers(chart: RoomMap, frame: str, at: Point) -> tuple[Obstacle, ...]:
    """What the safety filter of a base at `at` (x, y) [m] of `frame` must observe of the map.

    Of the traversable regions that hold `at`, the first in the map: their union is no barrier that a filter could keep,
    and their intersection would shut doors. Every keep_out region becomes the smallest rectangle around it. A map
    without traversable regions bounds nothing. Raises `InvalidSetup` if there are some and `at` lies in none.
    """
    rooms = chart.polygons(frame, "traversable")
    around = [room for room in rooms if inside(at, room[1])]
    if rooms and not around:
        names = ", ".join(name for name, _ in rooms)
        raise InvalidSetup("position of the base", got=at, allowed=f"inside a traversable region: {names}")
    walls = traversable(*around[0]) if around else ()
    return (*walls, *(_rectangle(name, corners) for name, corners in chart.polygons(frame, "keep_out")))


def _rectangle(name: str, corners: tuple[Point, ...]) -> Obstacle:
    """The smallest rectangle around a convex polygon; one of its sides lies on one of the polygon's (Freeman, 1975)."""
    turns = [atan2(by - ay, bx - ax) for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True)]
    boxes = [_box(corners, turn) for turn in turns]
    x, y, half_x, half_y, yaw = min(boxes, key=lambda box: box[2] * box[3])
    return keep_out(name, x, y, half_x, half_y, yaw)


def _box(corners: tuple[Point, ...], yaw: float) -> tuple[float, float, float, float, float]:
    """Centre and half sides [m] of the rectangle around `corners` whose x axis is turned by `yaw`."""
    c, s = cos(yaw), sin(yaw)
    along = [c * x + s * y for x, y in corners]
    across = [c * y - s * x for x, y in corners]
    u, v = (max(along) + min(along)) / 2, (max(across) + min(across)) / 2
    return c * u - s * v, s * u + c * v, (max(along) - min(along)) / 2, (max(across) - min(across)) / 2, yaw
