"""Maps: named places and regions of the floor or a table, in named frames, as values (paper 5: maps).

Geometry is looked up by name and never embedded. Whoever moves turns these values into scene places and barriers; this
room knows neither.
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
"""Coordinates beyond this [m] are taken for a mistake in the unit."""


class _MapElement(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Root of what a map is made of."""


class MapFrame(_MapElement, frozen=True):
    """A frame `name` that stands at `position` [m] in the map's own frame, turned by `yaw` [rad] about z."""

    name: str
    position: tuple[float, float, float]
    yaw: float = 0.0
    about: ShortText = ""


class MapPlace(_MapElement, frozen=True):
    """A named place: `position` [m] on its support and `yaw` [rad] to stand in; `region` is what belongs to it."""

    name: str
    position: tuple[float, float, float]
    yaw: float = 0.0
    frame: str = ""
    region: tuple[Point, ...] = ()
    about: ShortText = ""


class Region(_MapElement, frozen=True):
    """A polygon of the floor with `corners` (x, y) [m]: a base stays inside a traversable one, outside a keep_out."""

    name: str
    use: Literal["traversable", "keep_out"]
    corners: Polygon
    frame: str = ""
    about: ShortText = ""


class PlacePose(msgspec.Struct, frozen=True):
    """Where a place is in some frame: `position` [m] and `yaw` [rad]."""

    name: str
    position: tuple[float, float, float]
    yaw: float


class RoomMap(_MapElement, frozen=True):
    """A map in its own frame called `frame`; every other frame is given in it. Raises ValueError if it is not sound."""

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
                    raise ValueError(f"place {place.name!r} lies outside its own region")
        for region in self.regions:
            _check_polygon(region.name, region.corners, convex=True)
        for frame in self.frames:
            _check_numbers(frame.name, *frame.position, frame.yaw)

    def place_poses(self, frame: str) -> tuple[PlacePose, ...]:
        """Every place, seen from `frame`; raises `UnknownName`."""
        return tuple(
            PlacePose(one.name, *self._transform(one.frame, frame, one.position, one.yaw)) for one in self.places
        )

    def scene_places(self, frame: str) -> tuple[Place, ...]:
        """The places as a scene knows them, in the scene's frame."""
        return tuple(Place(one.name, one.position) for one in self.place_poses(frame))

    def polygons(
        self, frame: str, use: Literal["traversable", "keep_out"]
    ) -> tuple[tuple[str, tuple[Point, ...]], ...]:
        """Name and corners, counter-clockwise and seen from `frame`, of the regions with this `use`."""
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

    def places_containing(self, point: Point, frame: str) -> tuple[str, ...]:
        """The places whose region holds `point` (x, y) [m] of `frame`."""
        found: list[str] = []
        for place in self.places:
            (x, y, _), _ = self._transform(frame, place.frame, (*point, 0.0))
            if place.region and is_inside_polygon((x, y), place.region):
                found.append(place.name)
        return tuple(found)

    def _transform(
        self, source: str, target: str, position: tuple[float, float, float], yaw: float = 0.0
    ) -> tuple[tuple[float, float, float], float]:
        """A pose given in `source`, seen from `target`: T_target_map T_map_source p."""
        one, other = self._frame(source), self._frame(target)
        (x, y, z), turn = _rotate(position, one.yaw), one.yaw - other.yaw
        moved = (x + one.position[0] - other.position[0], y + one.position[1] - other.position[1])
        return _rotate((*moved, z + one.position[2] - other.position[2]), -other.yaw), yaw + turn

    def _frame(self, name: str) -> MapFrame:
        if name in {"", self.frame}:
            return MapFrame(self.frame, (0.0, 0.0, 0.0))
        for frame in self.frames:
            if frame.name == name:
                return frame
        raise UnknownNameError("frame", name, (self.frame, *(one.name for one in self.frames)), owner=self.title)


def is_inside_polygon(point: Point, polygon: tuple[Point, ...]) -> bool:
    """Whether `point` lies in the simple `polygon` (even-odd rule; on the border either may be said)."""
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
    """Twice the signed area; positive when counter-clockwise."""
    return sum(ax * by - bx * ay for (ax, ay), (bx, by) in zip(polygon, polygon[1:] + polygon[:1], strict=True))


def _counter_clockwise(polygon: tuple[Point, ...]) -> tuple[Point, ...]:
    return polygon if _doubled_area(polygon) > 0.0 else polygon[::-1]


def _check_polygon(name: str, polygon: tuple[Point, ...], *, convex: bool) -> None:
    _check_numbers(name, *(value for point in polygon for value in point))
    if len(polygon) < 3 or abs(_doubled_area(polygon)) < 1e-6:
        raise ValueError(f"the corners of {name!r} enclose nothing")
    if convex and not _is_convex(_counter_clockwise(polygon)):
        hint = "a room with corners inward is its convex hull with keep_out regions"
        raise ValueError(f"region {name!r} is not a convex polygon; {hint}")


def _is_convex(polygon: tuple[Point, ...]) -> bool:
    """Whether a counter-clockwise polygon turns left at every corner, once around (a star turns left too)."""
    edges = [(bx - ax, by - ay) for (ax, ay), (bx, by) in zip(polygon, polygon[1:] + polygon[:1], strict=True)]
    pairs = list(zip(edges, edges[1:] + edges[:1], strict=True))
    descents = sum(one[1] >= 0.0 > other[1] for one, other in pairs)
    return all(one[0] * other[1] - one[1] * other[0] > 0.0 for one, other in pairs) and descents == 1


def _check_numbers(name: str, *numbers: float) -> None:
    wrong = [number for number in numbers if not (isfinite(number) and abs(number) <= MAX_COORDINATE)]
    if wrong:
        raise ValueError(f"{name!r}: {wrong[0]!r} is no coordinate in metres or radians")


def _check_names(chart: RoomMap) -> None:
    """Identifiers, each once; only frames that are there."""
    groups = (chart.places, chart.regions, (*chart.frames, MapFrame(chart.frame, (0.0, 0.0, 0.0))))
    for group in groups:
        names = [one.name for one in group]
        try:
            SceneNames(receptive=tuple(names))
        except ConfigurationError as error:
            raise ValueError(str(error)) from error
        if len(set(names)) < len(names):
            raise ValueError(f"a name stands twice: {sorted(name for name in names if names.count(name) > 1)[0]!r}")
    frames = {"", *(one.name for one in groups[2])}
    unknown = {one.frame for one in (*chart.places, *chart.regions)} - frames
    if unknown:
        raise ValueError(f"frame {sorted(unknown)[0]!r} is not in this map")
