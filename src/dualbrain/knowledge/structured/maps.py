"""Maps: named places and regions of the floor or a table, in named frames, as values (paper 5: maps).

Geometry is looked up by name and never embedded. Other packages convert these values to scene places and barriers.
"""

from __future__ import annotations

from math import cos, isfinite, sin
from typing import Annotated, Literal

import msgspec

from dualbrain.contracts.scene_names import SceneNames
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.records import Place

Point = tuple[float, float]
Polygon = Annotated[tuple[Point, ...], msgspec.Meta(min_length=3, max_length=16)]
ShortText = Annotated[str, msgspec.Meta(max_length=400)]

MAX_COORDINATE = 1000.0
"""Larger coordinates [m] are rejected as mistakes in the unit."""


class _MapElement(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of the elements of a map."""


class MapFrame(_MapElement, frozen=True):
    """A frame `name` at `position` [m] in the frame of the map, rotated by `yaw` [rad] about z."""

    name: str
    position: tuple[float, float, float]
    yaw: float = 0.0
    about: ShortText = ""


class MapPlace(_MapElement, frozen=True, kw_only=True):
    """A named place in `frame`: `position` [m] on its support, `yaw` [rad] of a base at the place, and its `region`."""

    name: str
    position: tuple[float, float, float]
    yaw: float = 0.0
    frame: str = ""
    region: tuple[Point, ...] = ()
    about: ShortText = ""


class Region(_MapElement, frozen=True, kw_only=True):
    """A floor polygon with `corners` (x, y) [m]; a base stays inside traversable and outside keep_out regions."""

    name: str
    use: Literal["traversable", "keep_out"]
    corners: Polygon
    frame: str = ""
    about: ShortText = ""


class PlacePose(msgspec.Struct, frozen=True):
    """The pose of a place in some frame: `position` [m] and `yaw` [rad]."""

    name: str
    position: tuple[float, float, float]
    yaw: float


class RoomMap(_MapElement, frozen=True, kw_only=True):
    """A map in the frame `frame`, in which all other frames are given; raises `ValueError` if it is invalid."""

    kind: Literal["map"]
    title: ShortText
    frame: str
    about: ShortText = ""
    frames: Annotated[tuple[MapFrame, ...], msgspec.Meta(max_length=32)] = ()
    places: Annotated[tuple[MapPlace, ...], msgspec.Meta(max_length=200)] = ()
    regions: Annotated[tuple[Region, ...], msgspec.Meta(max_length=64)] = ()

    def __post_init__(self) -> None:
        """Check names, numbers and polygons."""
        _check_names(self)
        for place in self.places:
            _check_numbers(place.name, *place.position, place.yaw)
            if place.region:
                _check_polygon(place.name, place.region, convex=False)
                if not is_inside_polygon(place.position[:2], place.region):
                    raise ValueError(f"place {place.name!r} is outside its own region")
        for region in self.regions:
            _check_polygon(region.name, region.corners, convex=True)
        for frame in self.frames:
            _check_numbers(frame.name, *frame.position, frame.yaw)

    def place_poses(self, frame: str) -> tuple[PlacePose, ...]:
        """The pose of every place in `frame`; raises `UnknownNameError`."""
        return tuple(
            PlacePose(one.name, *self._transform(one.frame, frame, one.position, one.yaw)) for one in self.places
        )

    def scene_places(self, frame: str) -> tuple[Place, ...]:
        """The places as scene places, in the frame `frame` of the scene; raises `UnknownNameError`."""
        return tuple(Place(one.name, one.position) for one in self.place_poses(frame))

    def polygons(
        self, frame: str, use: Literal["traversable", "keep_out"]
    ) -> tuple[tuple[str, tuple[Point, ...]], ...]:
        """Name and counter-clockwise corners (x, y) [m] in `frame` of the regions with this `use`."""
        return tuple(
            (
                one.name,
                _counter_clockwise(
                    tuple(self._transform(one.frame, frame, (x, y, 0.0))[0][:2] for x, y in one.corners)
                ),
            )
            for one in self.regions
            if one.use == use
        )

    def _transform(
        self, source: str, target: str, position: tuple[float, float, float], yaw: float = 0.0
    ) -> tuple[tuple[float, float, float], float]:
        """A pose in `source`, expressed in `target`: T_target_map T_map_source p."""
        old, new = self._frame(source), self._frame(target)
        (x, y, z), rotation = _rotate(position, old.yaw), old.yaw - new.yaw
        xy = (x + old.position[0] - new.position[0], y + old.position[1] - new.position[1])
        return _rotate((*xy, z + old.position[2] - new.position[2]), -new.yaw), yaw + rotation

    def _frame(self, name: str) -> MapFrame:
        if name in {"", self.frame}:
            return MapFrame(self.frame, (0.0, 0.0, 0.0))
        for frame in self.frames:
            if frame.name == name:
                return frame
        raise UnknownNameError("frame", name, (self.frame, *(one.name for one in self.frames)), owner=self.title)


def is_inside_polygon(point: Point, polygon: tuple[Point, ...]) -> bool:
    """Whether `point` is in the simple `polygon` (even-odd rule; on the border the result is arbitrary)."""
    x, y = point
    odd = False
    for (ax, ay), (bx, by) in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        if (ay > y) != (by > y) and x < ax + (y - ay) / (by - ay) * (bx - ax):
            odd = not odd
    return odd


def _rotate(position: tuple[float, float, float], yaw: float) -> tuple[float, float, float]:
    x, y, z = position
    return (cos(yaw) * x - sin(yaw) * y, sin(yaw) * x + cos(yaw) * y, z)


def _doubled_area(polygon: tuple[Point, ...]) -> float:
    """Twice the signed area; positive for a counter-clockwise polygon."""
    return sum(ax * by - bx * ay for (ax, ay), (bx, by) in zip(polygon, polygon[1:] + polygon[:1], strict=True))


def _counter_clockwise(polygon: tuple[Point, ...]) -> tuple[Point, ...]:
    return polygon if _doubled_area(polygon) > 0.0 else polygon[::-1]


def _check_polygon(name: str, polygon: tuple[Point, ...], *, convex: bool) -> None:
    _check_numbers(name, *(value for point in polygon for value in point))
    if len(polygon) < 3 or abs(_doubled_area(polygon)) < 1e-6:
        raise ValueError(f"the corners of {name!r} enclose no area")
    if convex and not _is_convex(_counter_clockwise(polygon)):
        hint = "describe a non-convex room by its convex hull and keep_out regions"
        raise ValueError(f"region {name!r} is not a convex polygon; {hint}")


def _is_convex(polygon: tuple[Point, ...]) -> bool:
    """Whether a counter-clockwise polygon turns left at every corner, and winds once (a star winds more often)."""
    edges = [(bx - ax, by - ay) for (ax, ay), (bx, by) in zip(polygon, polygon[1:] + polygon[:1], strict=True)]
    pairs = list(zip(edges, edges[1:] + edges[:1], strict=True))
    descents = sum(one[1] >= 0.0 > other[1] for one, other in pairs)
    return all(one[0] * other[1] - one[1] * other[0] > 0.0 for one, other in pairs) and descents == 1


def _check_numbers(name: str, *numbers: float) -> None:
    wrong = [number for number in numbers if not (isfinite(number) and abs(number) <= MAX_COORDINATE)]
    if wrong:
        raise ValueError(f"{name!r}: {wrong[0]!r} is not a coordinate in metres or radians")


def _check_names(room_map: RoomMap) -> None:
    """Check that names are identifiers, each used once, and that all frames exist."""
    groups = (room_map.places, room_map.regions, (*room_map.frames, MapFrame(room_map.frame, (0.0, 0.0, 0.0))))
    for group in groups:
        names = [one.name for one in group]
        try:
            SceneNames(receptive=tuple(names))
        except ConfigurationError as error:
            raise ValueError(str(error)) from error
        if len(set(names)) < len(names):
            raise ValueError(f"a name occurs twice: {sorted(name for name in names if names.count(name) > 1)[0]!r}")
    frames = {"", *(one.name for one in groups[2])}
    unknown = {one.frame for one in (*room_map.places, *room_map.regions)} - frames
    if unknown:
        raise ValueError(f"frame {sorted(unknown)[0]!r} is not in this map")
