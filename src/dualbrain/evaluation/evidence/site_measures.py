"""Measures of the site file on which a hazard depends: the entries that are stated, with their lines."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import msgspec

from dualbrain.evaluation.evidence.requirement import SiteMeasure
from dualbrain.grounding.envelope.object_limits import describe_limits, stated_limits
from dualbrain.records import ObjectLimits
from dualbrain.robots.model import RobotModel
from dualbrain.robots.site_config import KeepOut, PersonEntry, PlaneEntry, RobotSettings, SiteFile
from dualbrain.safety.cbf.obstacles import NearSpeed, SpeedAndSeparation
from dualbrain.safety.integration.site import site_persons

NO_SITE = "no site file was given"
_UNRESTRICTED = "the planner may call every skill"


def describe_site_measure(measure: SiteMeasure, file: SiteFile | None, robot_model: RobotModel, record: str) -> str:
    """The state of a measure at the site; `record` describes the commissioning record."""
    if measure == "commissioning":
        return record
    if measure == "tool_speed":
        bound = robot_model.tool_speed
        source = f"the default of the robot model, chosen by dualbrain; {NO_SITE}" if file is None else bound.provenance
        return f"tool speed {bound.value:g} {bound.unit} ({source})"
    if file is None:
        return f"no site file: {_UNRESTRICTED}" if measure == "commander" else NO_SITE
    return _DESCRIPTIONS[measure](file)


def list_entries(file: SiteFile) -> list[tuple[str, str, str]]:
    """(entry, value, line) of every measure that the site file states."""
    site = file.site
    rows = [
        *_robot_entries(site.robot),
        *((f"plane {one.name}", _plane(one), f"plane[{k}]") for k, one in enumerate(site.plane)),
        *((f"keep-out box {one.name}", _box(one), f"keep_out[{k}]") for k, one in enumerate(site.keep_out)),
        *((f"person {name}", text, f"person.{name}") for name, text in _describe_persons(file).items()),
        *((f"object {name}", _limits(one), f"object.{name}") for name, one in stated_limits(file).items()),
        *((f"skills of {name}", ", ".join(one.skills), f"commander.{name}") for name, one in site.commander.items()),
    ]
    if site.tool is not None:
        rows.append(("tool", f"tip at {_vector(site.tool.position)} m, {len(site.tool.spheres)} spheres", "tool"))
    if site.payload is not None:
        rows.append(("payload", f"{len(site.payload.spheres)} spheres, error {site.payload.error:g} m", "payload"))
    return [(name, value, file.locate(path)) for name, value, path in rows]


def _robot_entries(robot: RobotSettings) -> list[tuple[str, str, str]]:
    """Entries of [robot] that are no bound of the robot model."""
    rows: list[tuple[str, str, str]] = []
    if robot.period is not None:
        rows.append(("control period", f"{robot.period:g} s", "robot.period"))
    if robot.moving_mass is not None:
        mass = f"{robot.moving_mass:g} kg, load {robot.load:g} kg"
        rows.append(("mass of the moving parts", mass, "robot.moving_mass"))
    return rows


def _plane(plane: PlaneEntry) -> str:
    parts = f"parts {', '.join(plane.parts)}" if plane.parts else "all parts"
    return f"through {_vector(plane.point)} m, inward {_vector(plane.inward)}, margin {plane.margin:g} m, {parts}"


def _box(box: KeepOut) -> str:
    size = f"half extents {_vector(box.half_extents)} m, yaw {box.yaw:g} rad"
    return f"at {_vector(box.position)} m, {size}, margin {box.margin:g} m"


def _describe_persons(file: SiteFile) -> dict[str, str]:
    """The limits near each person of the file in words, with the defaults of the entries that it does not state."""
    persons = site_persons(file)
    return {
        name: _describe_person(entry, persons.separation.get(name), persons.near.get(name)) if persons else ""
        for name, entry in file.site.person.items()
    }


def _describe_person(entry: PersonEntry, separation: SpeedAndSeparation | None, near: NearSpeed | None) -> str:
    monitoring = entry.monitoring.replace("_", " ")
    if separation is not None:
        reaction = f"reaction {separation.reaction:g} s, brake {separation.brake:g} m/s²"
        return f"{monitoring}, {reaction}, approach {separation.approach:g} m/s"
    if near is not None:
        limit = f"at most {near.speed:.3g} m/s within {near.distance:g} m for body region {entry.body_region}"
        source = f" ({entry.source})" if entry.source else ""
        return f"{monitoring}, {limit}{source}, brake {near.brake:g} m/s², approach {near.approach:g} m/s"
    return monitoring


def _vector(values: Iterable[float]) -> str:
    return "(" + ", ".join(f"{value:g}" for value in values) + ")"


def _obstacles(file: SiteFile) -> str:
    names = [
        *(f"plane {one.name} ({file.locate(f'plane[{k}]')})" for k, one in enumerate(file.site.plane)),
        *(f"keep-out box {one.name} ({file.locate(f'keep_out[{k}]')})" for k, one in enumerate(file.site.keep_out)),
    ]
    return "; ".join(names) or "the site states no plane and no keep-out box"


def _persons(file: SiteFile) -> str:
    entries = [f"{name}: {text} ({file.locate(f'person.{name}')})" for name, text in _describe_persons(file).items()]
    return "; ".join(entries) or "no limit near persons is stated: the obstacle barrier alone"


def _objects(file: SiteFile) -> str:
    entries = [f"{name}: {describe_limits(one)}" for name, one in stated_limits(file).items()]
    return "; ".join(entries) or "no limit of an object is stated"


def _limits(limits: ObjectLimits) -> str:
    return describe_limits(msgspec.structs.replace(limits, source=""))


def _commanders(file: SiteFile) -> str:
    entries = [
        f"{name}: {', '.join(one.skills)} ({file.locate(f'commander.{name}')})"
        for name, one in file.site.commander.items()
    ]
    return "; ".join(entries) or f"no restriction is stated: {_UNRESTRICTED}"


def _tool(file: SiteFile) -> str:
    tool = file.site.tool
    return "no tool is stated" if tool is None else f"tool of {len(tool.spheres)} spheres ({file.locate('tool')})"


def _payload(file: SiteFile) -> str:
    load = file.site.payload
    return "no payload is stated" if load is None else f"{len(load.spheres)} spheres ({file.locate('payload')})"


_DESCRIPTIONS: dict[SiteMeasure, Callable[[SiteFile], str]] = {
    "obstacles": _obstacles,
    "tool": _tool,
    "persons": _persons,
    "commander": _commanders,
    "objects": _objects,
    "payload": _payload,
}
