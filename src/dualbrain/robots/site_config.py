"""Site file (TOML): planes, keep-out boxes, tool, payload, limits and commanders of one installation of a robot.

The whole file is checked when it is read, and every error names line and column. A site file can only narrow the limits
of the robot. All numbers are in SI units, in the robot's base frame.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, cast, get_args, get_type_hints

import msgspec

from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.core.geometry import validation
from dualbrain.core.text import closest_name_hint
from dualbrain.core.untrusted.bounded_file import FileRefusal, read_regular_file
from dualbrain.core.untrusted.toml_document import TomlFault, parse_toml
from dualbrain.errors import ConfigurationError, GeometryError
from dualbrain.robots.model import Quaternion, Vector

T = TypeVar("T")
MAX_FILE_BYTES = 2**20
MAX_CARRIED_DISTANCE = 2.0
"""Largest coordinate and radius of the tool and of the payload in the tool frame [m]."""
PRINCIPALS = (PLANNER,)
"""Principals to which a site file can grant skills."""
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Length = Annotated[float, msgspec.Meta(ge=0.0, le=100.0)]
EntryName = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z][A-Za-z0-9_ -]{0,31}$")]


class SiteEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base class of the entries of a site file: an unknown field is an error, never ignored."""


class RobotSettings(SiteEntry, frozen=True, kw_only=True):
    """[robot]: control period [s], tool speed [m/s], mass of the moving parts and of the load [kg].

    The tool speed is also that of a base along its path. Only for a base: turn rate [rad/s], turn acceleration
    [rad/s²]. The masses serve the power and force limiting of [person.NAME].
    """

    period: Positive | None = None
    tool_speed: Positive | None = None
    moving_mass: Positive | None = None
    load: Annotated[float, msgspec.Meta(ge=0.0)] = 0.0
    turn: Positive | None = None
    turn_acceleration: Positive | None = None


class LimitCaps(SiteEntry, frozen=True):
    """[limits] of every joint: velocity [rad/s], acceleration [rad/s²], jerk [rad/s³]; prismatic joints in m."""

    velocity: Positive | None = None
    acceleration: Positive | None = None
    jerk: Positive | None = None


class JointCaps(LimitCaps, frozen=True, kw_only=True):
    """[joint.NAME]: the limits of one joint, and its range [rad or m]."""

    lower: float | None = None
    upper: float | None = None


class ToolSphere(SiteEntry, frozen=True):
    """A sphere in the tool frame: centre [m], radius [m]."""

    centre: Vector
    radius: Positive


class ToolEntry(SiteEntry, frozen=True):
    """[tool]: pose of its tip in the tool frame of the robot model [m], and its collision spheres in the same frame."""

    position: Vector = (0.0, 0.0, 0.0)
    quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)
    spheres: tuple[ToolSphere, ...] = ()


class Payload(SiteEntry, frozen=True):
    """[payload]: a permanent payload as at most 8 spheres in the tool frame, with the error of their position [m]."""

    spheres: Annotated[tuple[ToolSphere, ...], msgspec.Meta(min_length=1, max_length=8)]
    error: Length = 0.0


class PlaneEntry(SiteEntry, frozen=True, kw_only=True):
    """[[plane]]: the `parts` of the robot stay on the side to which `inward` points, `margin` [m] from the plane."""

    name: EntryName
    point: Vector
    inward: Vector
    parts: tuple[str, ...] = ()
    margin: Length = 0.0


class KeepOut(SiteEntry, frozen=True, kw_only=True):
    """[[keep_out]]: a box that no part of the robot may enter: position [m], half extents [m], yaw about z [rad]."""

    name: EntryName
    position: Vector
    half_extents: Annotated[tuple[Positive, Positive, Positive], msgspec.Meta()]
    yaw: float = 0.0
    margin: Length = 0.0


Monitoring = Literal["separation", "power_and_force", "barrier"]
OWN_REGION = "own"
"""`body_region` with the numbers of the site."""
OWN_REGION_ENTRIES = ("mass", "stiffness", "force", "transient", "source")
"""Entries of a person that only `body_region = "own"` uses."""
MONITORING_ENTRIES: dict[Monitoring, tuple[str, ...]] = {
    "barrier": (),
    "separation": ("reaction", "brake", "approach"),
    "power_and_force": ("body_region", "distance", "brake", "approach", "pressure", "area", *OWN_REGION_ENTRIES),
}
"""Entries of a person that each monitoring uses."""


class PersonEntry(SiteEntry, frozen=True, kw_only=True):
    """[person.NAME], for a person by name or for all `others`: the speed limit near the person.

    - `monitoring` "separation": the speed toward the person falls with the distance (`reaction` [s], `brake` [m/s²],
      `approach` [m/s]). "power_and_force": within `distance` [m] no part is faster than the contact speed of the body
      region minus `approach`, and decelerates to it with `brake` before. "barrier": the obstacle barrier alone.
    - `body_region`: name in `safety.integration.power_and_force.BODY_REGIONS`, or "own" with `mass` [kg], `stiffness`
      [N/m], `force` [N], `transient` and the `source` of these numbers. `pressure` [Pa] and `area` [m²] of the contact
      limit the force further.

    None: the default of the monitoring. An entry that the monitoring does not use is an error of `read_site`.
    """

    monitoring: Monitoring
    reaction: Annotated[float, msgspec.Meta(ge=0.0)] | None = None
    brake: Positive | None = None
    approach: Annotated[float, msgspec.Meta(ge=0.0)] | None = None
    body_region: str | None = None
    distance: Length | None = None
    mass: Positive | None = None
    stiffness: Positive | None = None
    force: Positive | None = None
    transient: Positive | None = None
    source: str | None = None
    pressure: Positive | None = None
    area: Positive | None = None


class ObjectEntry(SiteEntry, frozen=True, kw_only=True):
    """[object.NAME], for objects by name or category or for all `others`: limits of contracts that move the object.

    Largest grip `force` [N] on each finger, largest tool `speed` [m/s], least `clearance` [m].
    """

    force: Positive | None = None
    speed: Positive | None = None
    clearance: Positive | None = None


class Commander(SiteEntry, frozen=True):
    """[commander.NAME]: the skills that this principal may call."""

    skills: tuple[str, ...]


NAMED_TABLES = {"joint": JointCaps, "object": ObjectEntry, "person": PersonEntry, "commander": Commander}
"""Tables with names of their own, which are checked one by one because msgspec omits these names from its paths."""


class Site(SiteEntry, frozen=True, kw_only=True):
    """The content of a site file."""

    robot: RobotSettings = RobotSettings()
    limits: LimitCaps = LimitCaps()
    joint: dict[str, JointCaps] = {}
    tool: ToolEntry | None = None
    payload: Payload | None = None
    plane: tuple[PlaneEntry, ...] = ()
    keep_out: tuple[KeepOut, ...] = ()
    person: dict[str, PersonEntry] = {}
    object: dict[str, ObjectEntry] = {}
    commander: dict[str, Commander] = {}


@dataclass(frozen=True, slots=True)
class SiteFile:
    """A site with the line and column of every entry of its file."""

    path: Path
    site: Site
    locations: Mapping[str, tuple[int, int]]

    def locate(self, path: str) -> str:
        """File name and line of the entry at `path` (such as "limits.acceleration")."""
        line, _ = find_location(path, self.locations)
        return f"{self.path.name}:{line}"

    def make_error(self, path: str, *, got: object, allowed: str, sentence: str = "") -> SiteError:
        """The error of the entry at `path`; a `sentence` replaces `got` and `allowed`."""
        location = find_location(path, self.locations)
        return SiteError(self.path.name, location, path, got=got, allowed=allowed, sentence=sentence)


class SiteError(ConfigurationError):
    """A wrong entry of a site file, at `line` and `column` (from 1)."""

    def __init__(
        self, name: str, location: tuple[int, int], entry: str, *, got: object, allowed: str, sentence: str = ""
    ) -> None:
        """Report the file called `name`, the location and the entry; a `sentence` replaces `got` and `allowed`."""
        self.line, self.column = location
        where = f"{name}, line {location[0]}, column {location[1]}"
        stated = f"{where}: {sentence}" if sentence else ""
        super().__init__(f"{where}: {entry or 'file'}", got=got, allowed=allowed, sentence=stated)


def read_site(path: Path | str) -> SiteFile:
    """The site in the TOML file `path`.

    Raises:
        SiteError: The file is not TOML, an entry is unknown, missing, of the wrong type or out of bounds, or a
            principal is unknown.
        ConfigurationError: The file does not exist or is too large.
    """
    path = Path(path)
    content = read_regular_file(path, MAX_FILE_BYTES)
    if isinstance(content, FileRefusal):
        problem = f"There is no site file at {path}." if content.kind == "missing" else content.sentence
        raise ConfigurationError.stating(problem, fix=f"Give a TOML file of at most {MAX_FILE_BYTES} bytes.")
    try:
        text = content.decode()
    except UnicodeDecodeError as error:
        raise SiteError(path.name, (1, 1), "", got=str(error), allowed="UTF-8") from error
    data = parse_toml(text)
    if isinstance(data, TomlFault):
        raise SiteError(path.name, (data.line, data.column), "", got=data.problem, allowed="TOML")
    locations = _entry_locations(text)
    if (entry := _find_non_finite(data, "")) is not None:
        raise SiteError(path.name, find_location(entry, locations), entry, got="not finite", allowed="finite numbers")
    for table, kind in NAMED_TABLES.items():
        entries = data.get(table)
        if isinstance(entries, dict):
            for name, value in cast("dict[str, Any]", entries).items():
                _convert(value, kind, f"{table}.{name}", path, locations)
    site = _convert(data, Site, "", path, locations)
    for name in site.commander:
        if name not in PRINCIPALS:
            entry = f"commander.{name}"
            sentence = f"unknown principal {name!r} in [commander.{name}]; {closest_name_hint(name, PRINCIPALS)}."
            raise SiteError(
                path.name,
                find_location(entry, locations),
                entry,
                got=name,
                allowed=", ".join(PRINCIPALS),
                sentence=sentence,
            )
    file = SiteFile(path, site, locations)
    _check_geometry(file)
    _check_persons(file)
    return file


def _check_geometry(file: SiteFile) -> None:
    """Raise `SiteError` for a pose, size or normal that is not usable."""
    site = file.site
    carried: list[tuple[str, tuple[ToolSphere, ...]]] = []
    if site.tool is not None:
        _check_entry(file, "tool.position", validation.check_vector, site.tool.position, MAX_CARRIED_DISTANCE)
        _check_entry(file, "tool.quaternion", validation.check_quaternion, site.tool.quaternion)
        carried += [("tool", site.tool.spheres)]
    if site.payload is not None:
        carried += [("payload", site.payload.spheres)]
    for table, spheres in carried:
        for sphere in spheres:
            _check_entry(file, f"{table}.spheres", validation.check_vector, sphere.centre, MAX_CARRIED_DISTANCE)
            _check_entry(file, f"{table}.spheres", validation.check_length, sphere.radius, MAX_CARRIED_DISTANCE)
    for index, plane in enumerate(site.plane):
        _check_entry(file, f"plane[{index}].point", validation.check_vector, plane.point)
        if any(plane.inward):  # a normal of zeros is an error of `site_obstacles`
            _check_entry(file, f"plane[{index}].inward", validation.check_direction, plane.inward)
    for index, box in enumerate(site.keep_out):
        _check_entry(file, f"keep_out[{index}].position", validation.check_vector, box.position)
        for extent in box.half_extents:
            _check_entry(file, f"keep_out[{index}].half_extents", validation.check_length, extent)


def _check_persons(file: SiteFile) -> None:
    """Raise `SiteError` for an entry of a person that its monitoring, or its body region, does not use."""
    for name, person in file.site.person.items():
        for entry, value in msgspec.structs.asdict(person).items():
            if entry == "monitoring" or value is None:
                continue
            users = [one for one, entries in MONITORING_ENTRIES.items() if entry in entries]
            needed = ""
            if person.monitoring not in users:
                needed = " or ".join(f'monitoring = "{one}"' for one in users)
            elif entry in OWN_REGION_ENTRIES and person.body_region != OWN_REGION:
                needed = f'body_region = "{OWN_REGION}"'
            if needed:
                at = f"person.{name}"
                sentence = f'[{at}] with monitoring = "{person.monitoring}" does not use {entry}; {needed} does.'
                raise file.make_error(f"{at}.{entry}", got=value, allowed="no entry", sentence=sentence)


def _check_entry(file: SiteFile, entry: str, check: Callable[..., Any], *values: Any) -> None:
    try:
        check(entry, *values)
    except GeometryError as error:
        raise file.make_error(entry, got=error.got, allowed=error.allowed) from error


def _convert(data: Any, kind: type[T], prefix: str, path: Path, locations: Mapping[str, tuple[int, int]]) -> T:
    """`data`, the table called `prefix`, as `kind`; raises `SiteError` with the location of a wrong entry."""
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        got, _, at = str(error).partition(" - at `$")
        entry = f"{prefix}.{at.strip('`.')}".strip(".")
        if field := re.search(r"unknown field `(.+)`", got):
            entry = f"{entry}.{field.group(1)}".lstrip(".")
        sentence = _describe_wrong_entry(got, entry, _find_struct(kind, at))
        location = find_location(entry, locations)
        raise SiteError(
            path.name, location, entry, got=got, allowed="see docs/how-to/site.md", sentence=sentence
        ) from error


# --- descriptions of wrong entries ----------------------------------------------------------------------------------

_TYPE_WORDS = {
    "float": "a number",
    "int": "an integer",
    "str": "a text",
    "bool": "a truth value",
    "array": "an array",
    "object": "a table",
}
_EXPECTED = re.compile(r"Expected `(\w+)(?: \| null)?`(.*?)(?:, got (.+))?$")


def _describe_wrong_entry(problem: str, entry: str, table: type[msgspec.Struct] | None) -> str:
    """A sentence about the `problem` that msgspec reports for `entry`, which is (or is in) a table of type `table`."""
    if (missing := re.search(r"missing required field `(.+)`", problem)) is not None:
        return f"{_table_name(entry)} lacks the entry {missing.group(1)!r}."
    if (unknown := re.search(r"unknown field `(.+)`", problem)) is not None:
        known = tuple(table.__struct_fields__) if table is not None else ()
        hint = closest_name_hint(unknown.group(1), known)
        names = "" if hint.startswith("known") else f"; known: {', '.join(known)}"
        owner = _table_name(entry.removesuffix(unknown.group(1)).rstrip("."))
        return f"unknown entry {unknown.group(1)!r} in {owner}; {hint}{names}."
    if (expected := _EXPECTED.match(problem)) is None:
        return f"{entry}: {problem}; see docs/how-to/site.md."
    kind, bound, got = expected.groups()
    words = f"{_TYPE_WORDS.get(kind, kind)}{bound}"
    if bound.startswith(" matching"):
        words = "a name of at most 32 letters, digits, spaces, _ and -, which begins with a letter"
    found = (got or "").strip("`")
    suffix = f", but is {_TYPE_WORDS[found]}" if found in _TYPE_WORDS else f", not {found}" if found else ""
    return f"{entry} must be {words}{suffix}."


def _table_name(path: str) -> str:
    """The header of the table at `path` as the file states it: "[robot]", "[[plane]]"; "the file" for ""."""
    if not path:
        return "the file"
    return f"[[{path.partition('[')[0]}]]" if re.fullmatch(r"\w+\[\d+\]", path) else f"[{path}]"


def _find_struct(kind: Any, path: str) -> type[msgspec.Struct] | None:
    """The innermost type of table on the way along the `path` of msgspec (such as ".spheres[0]") from `kind`."""
    table = _struct_of(kind)
    for name in re.findall(r"[A-Za-z_]+", path):
        fields = get_type_hints(table) if table is not None else {}
        table = _struct_of(fields.get(name)) or table
    return table


def _struct_of(kind: Any) -> type[msgspec.Struct] | None:
    """The type of table that `kind` is or contains (in a tuple, or as an optional value)."""
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return kind
    return next((found for part in get_args(kind) if (found := _struct_of(part)) is not None), None)


# --- locations of entries -------------------------------------------------------------------------------------------

_TABLE = re.compile(r"^\s*(\[\[?)\s*([^\]\s](?:[^\]]*[^\]\s])?)\s*\]\]?\s*(?:#.*)?$")
_KEY = re.compile(r"^\s*((?:[A-Za-z0-9_-]+|\"[^\"]*\"|'[^']*')(?:\s*\.\s*(?:[A-Za-z0-9_-]+|\"[^\"]*\"))*)\s*=\s*")


def _entry_locations(text: str) -> dict[str, tuple[int, int]]:
    """Line and column (from 1) of every table and key, by the path that msgspec uses for it."""
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
    """The table name with indices of arrays of tables, such as "plane[1]" for the second plane."""
    parts: list[str] = []
    for end, part in enumerate(table.split("."), start=1):
        prefix = ".".join(table.split(".")[:end])
        parts.append(f"{part}[{counts[prefix]}]" if prefix in counts else part)
    return ".".join(parts)


def find_location(path: str, locations: Mapping[str, tuple[int, int]]) -> tuple[int, int]:
    """The location of the entry at `path`, or of the innermost known entry that contains it."""
    path = path.replace("[...]", "")
    while path and path not in locations:
        path = path[: path.rindex("[")] if path.endswith("]") else path.rpartition(".")[0]
    return locations.get(path, (1, 1))


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
