"""What no description says and a site must: accelerations, control period, speeds. Nothing here has a default."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import msgspec

from dualbrain.errors import InvalidSetup
from dualbrain.robots.importer.kinematic_tree import TreeJoint
from dualbrain.robots.model import Bound
from dualbrain.robots.site_config import SiteFile

TURNS = 50.0
"""A joint without end is counted within ± this [rad]: 8 turns, within which float32 still tells 4 µrad apart."""

SIDES = ("lower", "upper", "velocity", "acceleration", "jerk")
FIX = {
    "lower": "[joint.NAME] lower = … in the site file",
    "upper": "[joint.NAME] upper = … in the site file",
    "velocity": "--velocity VALUE, or velocity = … under [limits] or [joint.NAME] in the site file",
    "acceleration": "--acceleration VALUE, or acceleration = … under [limits] or [joint.NAME] in the site file",
    "period": "--period SECONDS, or [robot] period = … in the site file",
    "tool_speed": "--tool-speed VALUE, or [robot] tool_speed = … in the site file",
    "speed": "--tool-speed VALUE, or [robot] tool_speed = … in the site file",
    "turn": "--turn VALUE, or [robot] turn = … in the site file",
    "turn_acceleration": "--turn-acceleration VALUE, or [robot] turn_acceleration = … in the site file",
}


@dataclass(frozen=True, slots=True)
class Given:
    """One number that a person gave, and where: "site policy (lab.toml:7)" or "site policy (--acceleration)"."""

    value: float
    provenance: str


@dataclass(frozen=True, slots=True)
class Policy:
    """What the site says of a robot: `every` for all joints, `joints` by name, `robot` for the whole."""

    every: Mapping[str, Given] = field(default_factory=dict[str, Given])
    joints: Mapping[str, Mapping[str, Given]] = field(default_factory=dict[str, Mapping[str, Given]])
    robot: Mapping[str, Given] = field(default_factory=dict[str, Given])

    def of(self, joint: str, side: str) -> Given | None:
        """What is said of one side of one joint, its own word first."""
        return self.joints.get(joint, {}).get(side) or self.every.get(side)


@dataclass(frozen=True, slots=True)
class Missing:
    """A limit that neither the description nor the site states."""

    what: str
    side: str

    def __str__(self) -> str:
        return f"{self.what}: give {FIX[self.side].replace('NAME', self.what.partition(':')[0])}"


class MissingLimits(InvalidSetup):
    """Limits that nobody stated; `missing` lists them all, so that one answer suffices."""

    def __init__(self, source: str, missing: tuple[Missing, ...]) -> None:
        """Name every missing limit of `source`."""
        self.missing = missing
        asked = "\n  ".join(dict.fromkeys(_grouped(missing)))
        super().__init__(
            f"limits of {source}", got=f"{len(missing)} missing", allowed="each stated by the file or by the site",
            fix=f"Nothing is assumed. Please say:\n  {asked}",
        )  # fmt: skip


def _grouped(missing: tuple[Missing, ...]) -> list[str]:
    """One line a side, with the joints it is missing of."""
    lines: list[str] = []
    for side in dict.fromkeys(one.side for one in missing):
        whose = [one.what for one in missing if one.side == side]
        shown = ", ".join(whose[:8]) + (f" and {len(whose) - 8} more" if len(whose) > 8 else "")
        lines.append(f"{side.replace('_', ' ')} ({shown}): {FIX[side]}")
    return lines


def joint_bounds(joint: TreeJoint, policy: Policy, missing: list[Missing]) -> dict[str, Bound | None]:
    """Lower, upper, velocity, acceleration, jerk of a joint, each with its provenance; adds to `missing`.

    The file's bound and the site's are both kept: the narrower one holds. A number alone (`--velocity 1`) narrows too.

    Raises:
        InvalidSetup: a range is empty, or a speed or acceleration is not above zero.
    """
    unit = "m" if joint.kind == "prismatic" else "rad"
    units = {
        "lower": unit,
        "upper": unit,
        "velocity": f"{unit}/s",
        "acceleration": f"{unit}/s^2",
        "jerk": f"{unit}/s^3",
    }
    told = {"lower": joint.lower, "upper": joint.upper, "velocity": joint.velocity, "acceleration": joint.acceleration}
    bounds = {
        side: _narrower(side, _told(joint, side, told.get(side)), policy.of(joint.name, side), units[side])
        for side in SIDES
    }
    for side in SIDES[:4]:
        if bounds[side] is None:
            missing.append(Missing(joint.name, side))
    for side in SIDES[2:]:
        bound = bounds[side]
        if bound is not None and not bound.value > 0.0:
            raise InvalidSetup(f"{side} of {joint.name!r} ({bound.provenance})", got=bound.value, allowed="above 0")
    lower, upper = bounds["lower"], bounds["upper"]
    if lower is not None and upper is not None and not lower.value < upper.value:
        raise InvalidSetup(
            f"range of {joint.name!r} ({lower.provenance}; {upper.provenance})", got=[lower.value, upper.value],
            allowed="lower below upper",
        )  # fmt: skip
    return bounds


def _told(joint: TreeJoint, side: str, value: float | None) -> Given | None:
    """What the description says."""
    if joint.kind == "continuous" and side in ("lower", "upper"):
        said = f"{joint.where}: continuous, no limit; turns are counted within ±{TURNS:g} rad"
        return Given(-TURNS if side == "lower" else TURNS, said)
    if value is None or (side == "velocity" and value <= 0.0):
        return None
    return Given(value, f"{joint.where}: {joint.name} limit {side}")


def _narrower(side: str, told: Given | None, site: Given | None, unit: str) -> Bound | None:
    if told is None and site is None:
        return None
    if told is None or site is None:
        one = told or site
        assert one is not None
        return Bound(one.value, unit, one.provenance)
    narrower = site.value > told.value if side == "lower" else site.value < told.value
    narrow, wide = (site, told) if narrower else (told, site)
    return Bound(narrow.value, unit, f"{narrow.provenance}; wider: {wide.value:g} of {wide.provenance}")


def whole_bound(side: str, unit: str, policy: Policy, missing: list[Missing]) -> Bound:
    """A bound of the whole robot (tool speed, period); 0 and an entry in `missing` where nobody stated it."""
    given = policy.robot.get(side)
    if given is None:
        missing.append(Missing("robot", side))
        return Bound(0.0, unit, "missing")
    if not given.value > 0.0:
        raise InvalidSetup(f"{side} ({given.provenance})", got=given.value, allowed="above 0")
    return Bound(given.value, unit, given.provenance)


WHOLE = ("period", "tool_speed", "turn", "turn_acceleration", "grip_force", "grip_force_min")


def policy_of(file: SiteFile | None, options: Mapping[str, float | None]) -> Policy:
    """The policy of `file`, with `options` (acceleration, velocity, period, tool_speed, turn, …) first."""
    said = {key: Given(value, f"site policy ({_option(key)})") for key, value in options.items() if value}
    every = {side: said[side] for side in ("velocity", "acceleration", "jerk") if side in said}
    whole = {side: said[side] for side in WHOLE if side in said}
    if file is None:
        return Policy(every, {}, whole)
    site = file.site
    joints = {name: _given(file, caps, f"joint.{name}") for name, caps in site.joint.items()}
    return Policy(_given(file, site.limits, "limits") | every, joints, _given(file, site.robot, "robot") | whole)


def _option(key: str) -> str:
    return "--grip" if key.startswith("grip") else f"--{key.replace('_', '-')}"


def _given(file: SiteFile, entry: msgspec.Struct, path: str) -> dict[str, Given]:
    """Every number of `entry` that is stated."""
    return {
        side: Given(float(value), f"site policy ({file.where(f'{path}.{side}')})")
        for side, value in msgspec.structs.asdict(entry).items() if value is not None
    }  # fmt: skip
