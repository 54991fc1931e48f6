"""Measures of the site file on which a hazard depends: the entries that are stated, with their lines."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import msgspec

from dualbrain.evaluation.evidence.requirement import SiteMeasure
from dualbrain.grounding.envelope.object_limits import describe_limits, stated_limits
from dualbrain.records import ObjectLimits
from dualbrain.robots.model import RobotModel
from dualbrain.robots.site_config import SiteFile

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
        *((f"plane {one.name}", _plane(one.inward, one.margin), f"plane[{k}]") for k, one in enumerate(site.plane)),
        *(
            (f"keep-out box {one.name}", f"at {_vector(one.position)} m, margin {one.margin:g} m", f"keep_out[{k}]")
            for k, one in enumerate(site.keep_out)
        ),
        *((f"person {name}", one.monitoring.replace("_", " "), f"person.{name}") for name, one in site.person.items()),
        *((f"object {name}", _limits(one), f"object.{name}") for name, one in stated_limits(file).items()),
        *((f"skills of {name}", ", ".join(one.skills), f"commander.{name}") for name, one in site.commander.items()),
    ]
    if site.tool is not None:
        rows.append(("tool", f"{len(site.tool.spheres)} spheres", "tool"))
    if site.payload is not None:
        rows.append(("payload", f"{len(site.payload.spheres)} spheres, error {site.payload.error:g} m", "payload"))
    return [(name, value, file.locate(path)) for name, value, path in rows]


def _plane(inward: Iterable[float], margin: float) -> str:
    return f"inward {_vector(inward)}, margin {margin:g} m"


def _vector(values: Iterable[float]) -> str:
    return "(" + ", ".join(f"{value:g}" for value in values) + ")"


def _obstacles(file: SiteFile) -> str:
    names = [
        *(f"plane {one.name} ({file.locate(f'plane[{k}]')})" for k, one in enumerate(file.site.plane)),
        *(f"keep-out box {one.name} ({file.locate(f'keep_out[{k}]')})" for k, one in enumerate(file.site.keep_out)),
    ]
    return "; ".join(names) or "the site states no plane and no keep-out box"


def _persons(file: SiteFile) -> str:
    entries = [
        f"{name}: {one.monitoring.replace('_', ' ')} ({file.locate(f'person.{name}')})"
        for name, one in file.site.person.items()
    ]
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
