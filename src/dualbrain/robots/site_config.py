"""One file in which a site says what holds there: planes, keep-out boxes, tool, payload, speed caps, who may command.

TOML, checked as a whole when it is read: every error names the line and column. Nothing in it can widen a limit of the
robot; caps narrow. All numbers are SI, in the robot's base frame.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

import msgspec

from dualbrain.errors import ConfigurationError
from dualbrain.robots.model import Quaternion, Vector

T = TypeVar("T")
MAX_FILE_BYTES = 2**20
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Length = Annotated[float, msgspec.Meta(ge=0.0, le=100.0)]
EntryName = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z][A-Za-z0-9_ -]{0,31}$")]


class SiteEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Root of what a site file holds: a word that is not known is an error, never ignored."""


class RobotSettings(SiteEntry, frozen=True):
    """[robot]: control period [s], tool speed [m/s]; of a base turn rate [rad/s] and turn acceleration [rad/s²]."""

    period: Positive | None = None
    tool_speed: Positive | None = None
    turn: Positive | None = None
    turn_acceleration: Positive | None = None


class LimitCaps(SiteEntry, frozen=True):
    """[limits] for every joint: velocity [rad/s], acceleration [rad/s²], jerk [rad/s³]; m for prismatic ones."""

    velocity: Positive | None = None
    acceleration: Positive | None = None
    jerk: Positive | None = None


class JointCaps(LimitCaps, frozen=True):
    """[joint.NAME]: as [limits], and the range [rad or m]."""

    lower: float | None = None
    upper: float | None = None


class ToolSphere(SiteEntry, frozen=True):
    """A sphere in the tool's frame: centre [m], radius [m]."""

    centre: Vector
    radius: Positive


class ToolEntry(SiteEntry, frozen=True):
    """[tool]: its tip in the body's tool frame, and the spheres that cover it, in the same frame."""

    position: Vector = (0.0, 0.0, 0.0)
    quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)
    spheres: tuple[ToolSphere, ...] = ()


class Payload(SiteEntry, frozen=True):
    """[payload]: what the robot always carries: at most 8 spheres in the tool frame, error of their place [m]."""

    spheres: Annotated[tuple[ToolSphere, ...], msgspec.Meta(min_length=1, max_length=8)]
    error: Length = 0.0


class PlaneEntry(SiteEntry, frozen=True):
    """[[plane]]: parts of the robot stay on the side to which `inward` points, `margin` [m] from it."""

    name: EntryName
    point: Vector
    inward: Vector
    parts: tuple[str, ...] = ()
    margin: Length = 0.0


class KeepOut(SiteEntry, frozen=True):
    """[[keep_out]]: a box that no part of the robot enters: position, half extents [m], yaw about z [rad]."""

    name: EntryName
    position: Vector
    half_extents: Annotated[tuple[Positive, Positive, Positive], msgspec.Meta()]
    yaw: float = 0.0
    margin: Length = 0.0


class Commander(SiteEntry, frozen=True):
    """[commander.NAME]: the skills that this principal may call."""

    skills: tuple[str, ...]


class Site(SiteEntry, frozen=True):
    """Everything that a site file says."""

    robot: RobotSettings = RobotSettings()
    limits: LimitCaps = LimitCaps()
    joint: dict[str, JointCaps] = {}
    tool: ToolEntry | None = None
    payload: Payload | None = None
    plane: tuple[PlaneEntry, ...] = ()
    keep_out: tuple[KeepOut, ...] = ()
    commander: dict[str, Commander] = {}


@dataclass(frozen=True, slots=True)
class SiteFile:
    """A site with the places of its entries in the file."""

    path: Path
    site: Site
    locations: Mapping[str, tuple[int, int]]

    def locate(self, path: str) -> str:
        """File and line of the entry at `path` (such as "limits.acceleration")."""
        line, _ = find_location(path, self.locations)
        return f"{self.path.name}:{line}"

    def make_error(self, path: str, *, got: object, allowed: str) -> SiteError:
        """The error of what stands at `path`."""
        return SiteError(self.path.name, find_location(path, self.locations), path, got=got, allowed=allowed)


class SiteError(ConfigurationError):
    """What is wrong in a site file, and at which `line` and `column` (from 1)."""

    def __init__(self, name: str, location: tuple[int, int], what: str, *, got: object, allowed: str) -> None:
        """Name the file, the place and the entry."""
        self.line, self.column = location
        super().__init__(
            f"{name}, line {location[0]}, column {location[1]}: {what or 'file'}", got=got, allowed=allowed
        )


def read_site(path: Path) -> SiteFile:
    """The site in `path`.

    Raises:
        SiteError: it is not TOML, or an entry is unknown, missing, of the wrong kind or out of bounds.
        InvalidSetup: the file is not there, or too large.
    """
    if not path.is_file() or path.stat().st_size > MAX_FILE_BYTES:
        raise ConfigurationError("site file", got=str(path), allowed=f"a TOML file of at most {MAX_FILE_BYTES} bytes")
    try:
        text = path.read_bytes().decode()
        data = tomllib.loads(text)
    except UnicodeDecodeError as error:
        raise SiteError(path.name, (1, 1), "", got=str(error), allowed="UTF-8") from error
    except tomllib.TOMLDecodeError as error:
        raise SiteError(
            path.name, _parse_error_location(str(error), path), "", got=str(error), allowed="TOML"
        ) from error
    places = _entry_locations(text)
    if (bad := _find_non_finite(data, "")) is not None:
        raise SiteError(path.name, find_location(bad, places), bad, got="not finite", allowed="finite numbers")
    for table, kind in (
        ("joint", JointCaps),
        ("commander", Commander),
    ):  # by name, which msgspec leaves out of its path
        entries = data.get(table)
        if isinstance(entries, dict):
            for name, entry in cast("dict[str, Any]", entries).items():
                _convert(entry, kind, f"{table}.{name}", path, places)
    return SiteFile(path, _convert(data, Site, "", path, places), places)


def _convert(data: Any, kind: type[T], prefix: str, path: Path, places: Mapping[str, tuple[int, int]]) -> T:
    """`data` as `kind`; raises `SiteError` with the place of what does not fit, which stands under `prefix`."""
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        what, _, at = str(error).partition(" - at `$")
        entry = f"{prefix}.{at.strip('`.')}".strip(".")
        if field := re.search(r"unknown field `(.+)`", what):
            entry = f"{entry}.{field.group(1)}".lstrip(".")
        raise SiteError(
            path.name, find_location(entry, places), entry, got=what, allowed="see docs/how-to/site.md"
        ) from error


# --- where things stand ---------------------------------------------------------------------------------------------

_TABLE = re.compile(r"^\s*(\[\[?)\s*([^\]]+?)\s*\]\]?\s*(?:#.*)?$")
_KEY = re.compile(r"^\s*((?:[A-Za-z0-9_-]+|\"[^\"]*\"|'[^']*')(?:\s*\.\s*(?:[A-Za-z0-9_-]+|\"[^\"]*\"))*)\s*=\s*")


def _entry_locations(text: str) -> dict[str, tuple[int, int]]:
    """Line and column (from 1) of every table and key, under the path by which msgspec names it."""
    found: dict[str, tuple[int, int]] = {"": (1, 1)}
    counts: dict[str, int] = {}
    table = ""
    for number, line in enumerate(text.splitlines(), start=1):
        if header := _TABLE.match(line):
            table = _strip_quotes(header.group(2))
            if header.group(1) == "[[":
                counts[table] = counts.get(table, -1) + 1
            table = _indexed_name(table, counts)
            found.setdefault(table, (number, header.start(1) + 1))
        elif key := _KEY.match(line):
            path = f"{table}.{_strip_quotes(key.group(1))}".lstrip(".")
            found.setdefault(path, (number, key.end() + 1))
    return found


def _strip_quotes(dotted: str) -> str:
    return ".".join(part.strip().strip("\"'") for part in dotted.split("."))


def _indexed_name(table: str, counts: Mapping[str, int]) -> str:
    """The name with numbers, "plane[1]" for the second of its kind; also inside of dotted names."""
    parts: list[str] = []
    for end, part in enumerate(table.split("."), start=1):
        prefix = ".".join(table.split(".")[:end])
        parts.append(f"{part}[{counts[prefix]}]" if prefix in counts else part)
    return ".".join(parts)


def find_location(path: str, locations: Mapping[str, tuple[int, int]]) -> tuple[int, int]:
    """The place of `path`, or of the nearest entry around it."""
    path = path.replace("[...]", "")
    while path and path not in locations:
        path = path[: path.rindex("[")] if path.endswith("]") else path.rpartition(".")[0]
    return locations.get(path, (1, 1))


def _parse_error_location(message: str, path: Path) -> tuple[int, int]:
    """Line and column as tomllib tells them; at the end of the document, the last line."""
    if found := re.search(r"line (\d+), column (\d+)", message):
        return int(found.group(1)), int(found.group(2))
    return max(1, len(path.read_bytes().splitlines())), 1


def _find_non_finite(value: Any, path: str) -> str | None:
    """The path of the first number that is not finite."""
    match value:
        case float() if not isfinite(value):
            return path
        case dict():
            table = cast("dict[str, Any]", value)
            found = (_find_non_finite(inner, f"{path}.{key}".lstrip(".")) for key, inner in table.items())
        case list():
            found = (_find_non_finite(inner, f"{path}[{i}]") for i, inner in enumerate(cast("list[Any]", value)))
        case _:
            return None
    return next((one for one in found if one is not None), None)
