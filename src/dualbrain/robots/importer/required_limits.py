"""Limits that a description often leaves out and a site must state: accelerations, control period, speeds.

No limit has a default. Where both the description and the site state a limit, the narrower one holds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import msgspec

from dualbrain.errors import ConfigurationError
from dualbrain.robots.importer.kinematic_tree import TreeJoint
from dualbrain.robots.model import Bound
from dualbrain.robots.site_config import SiteFile

CONTINUOUS_JOINT_RANGE = 50.0
"""A joint without end is counted within ± this [rad]: 8 turns, within which float32 still tells 4 µrad apart."""

LIMIT_NAMES = ("lower", "upper", "velocity", "acceleration", "jerk")
FIX_HINTS = {
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
class StatedLimit:
    """One number that a person gave, and where: "site policy (lab.toml:7)" or "site policy (--acceleration)"."""

    value: float
    provenance: str


@dataclass(frozen=True, slots=True)
class LimitPolicy:
    """What the site says of a robot: `every` for all joints, `joints` by name, `robot` for the whole."""

    all_joints: Mapping[str, StatedLimit] = field(default_factory=dict[str, StatedLimit])
    by_joint: Mapping[str, Mapping[str, StatedLimit]] = field(default_factory=dict[str, Mapping[str, StatedLimit]])
    robot: Mapping[str, StatedLimit] = field(default_factory=dict[str, StatedLimit])

    def limit_of(self, joint: str, name: str) -> StatedLimit | None:
        """What is said of one side of one joint, its own word first."""
        return self.by_joint.get(joint, {}).get(name) or self.all_joints.get(name)


@dataclass(frozen=True, slots=True)
class MissingLimit:
    """A limit that neither the description nor the site states."""

    owner: str
    limit: str

    def __str__(self) -> str:
        return f"{self.owner}: give {FIX_HINTS[self.limit].replace('NAME', self.owner.partition(':')[0])}"


class MissingLimitsError(ConfigurationError):
    """Limits that nobody stated; `missing` lists them all, so that one answer suffices."""

    def __init__(self, source: str, missing: tuple[MissingLimit, ...]) -> None:
        """Name every missing limit of `source`."""
        self.missing = missing
        asked = "\n  ".join(dict.fromkeys(_group_by_limit(missing)))
        super().__init__(
            f"limits of {source}",
            got=f"{len(missing)} missing",
            allowed="each stated by the file or by the site",
            fix=f"Nothing is assumed. Please say:\n  {asked}",
        )


def _group_by_limit(missing: tuple[MissingLimit, ...]) -> list[str]:
    """One line a side, with the joints it is missing of."""
    lines: list[str] = []
    for side in dict.fromkeys(one.limit for one in missing):
        whose = [one.owner for one in missing if one.limit == side]
        shown = ", ".join(whose[:8]) + (f" and {len(whose) - 8} more" if len(whose) > 8 else "")
        lines.append(f"{side.replace('_', ' ')} ({shown}): {FIX_HINTS[side]}")
    return lines


def joint_bounds(joint: TreeJoint, policy: LimitPolicy, missing: list[MissingLimit]) -> dict[str, Bound | None]:
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
    described = {
        "lower": joint.lower,
        "upper": joint.upper,
        "velocity": joint.velocity,
        "acceleration": joint.acceleration,
        "jerk": joint.jerk,
    }
    bounds = {
        side: _narrower_bound(
            side, _described_limit(joint, side, described[side]), policy.limit_of(joint.name, side), units[side]
        )
        for side in LIMIT_NAMES
    }
    for side in LIMIT_NAMES[:4]:
        if bounds[side] is None:
            missing.append(MissingLimit(joint.name, side))
    for side in LIMIT_NAMES[2:]:
        bound = bounds[side]
        if bound is not None and not bound.value > 0.0:
            raise ConfigurationError(
                f"{side} of {joint.name!r} ({bound.provenance})", got=bound.value, allowed="above 0"
            )
    lower, upper = bounds["lower"], bounds["upper"]
    if lower is not None and upper is not None and not lower.value < upper.value:
        raise ConfigurationError(
            f"range of {joint.name!r} ({lower.provenance}; {upper.provenance})",
            got=[lower.value, upper.value],
            allowed="lower below upper",
        )
    return bounds


def _described_limit(joint: TreeJoint, side: str, value: float | None) -> StatedLimit | None:
    """What the description says."""
    if joint.kind == "continuous" and side in ("lower", "upper"):
        said = (
            f"{joint.source_location}: continuous, no limit; turns are counted within ±{CONTINUOUS_JOINT_RANGE:g} rad"
        )
        return StatedLimit(-CONTINUOUS_JOINT_RANGE if side == "lower" else CONTINUOUS_JOINT_RANGE, said)
    if value is None or (side == "velocity" and value <= 0.0):
        return None
    return StatedLimit(value, f"{joint.source_location}: {joint.name} limit {side}")


def _narrower_bound(side: str, described: StatedLimit | None, site: StatedLimit | None, unit: str) -> Bound | None:
    if described is None and site is None:
        return None
    if described is None or site is None:
        one = described or site
        assert one is not None
        return Bound(one.value, unit, one.provenance)
    narrower = site.value > described.value if side == "lower" else site.value < described.value
    narrow, wide = (site, described) if narrower else (described, site)
    return Bound(narrow.value, unit, f"{narrow.provenance}; wider: {wide.value:g} of {wide.provenance}")


def robot_bound(name: str, unit: str, policy: LimitPolicy, missing: list[MissingLimit]) -> Bound:
    """A bound of the whole robot (tool speed, period); 0 and an entry in `missing` where nobody stated it."""
    given = policy.robot.get(name)
    if given is None:
        missing.append(MissingLimit("robot", name))
        return Bound(0.0, unit, "missing")
    if not given.value > 0.0:
        raise ConfigurationError(f"{name} ({given.provenance})", got=given.value, allowed="above 0")
    return Bound(given.value, unit, given.provenance)


ROBOT_LIMIT_NAMES = ("period", "tool_speed", "turn", "turn_acceleration", "grip_force", "grip_force_min")


def make_limit_policy(file: SiteFile | None, options: Mapping[str, float | None]) -> LimitPolicy:
    """The policy of `file`, with `options` (acceleration, velocity, period, tool_speed, turn, …) first."""
    said = {key: StatedLimit(value, f"site policy ({_option_name(key)})") for key, value in options.items() if value}
    every = {side: said[side] for side in ("velocity", "acceleration", "jerk") if side in said}
    whole = {side: said[side] for side in ROBOT_LIMIT_NAMES if side in said}
    if file is None:
        return LimitPolicy(every, {}, whole)
    site = file.site
    joints = {name: _stated_limits(file, caps, f"joint.{name}") for name, caps in site.joint.items()}
    return LimitPolicy(
        _stated_limits(file, site.limits, "limits") | every, joints, _stated_limits(file, site.robot, "robot") | whole
    )


def _option_name(key: str) -> str:
    return "--grip" if key.startswith("grip") else f"--{key.replace('_', '-')}"


def _stated_limits(file: SiteFile, entry: msgspec.Struct, path: str) -> dict[str, StatedLimit]:
    """Every number of `entry` that is stated."""
    return {
        side: StatedLimit(float(value), f"site policy ({file.locate(f'{path}.{side}')})")
        for side, value in msgspec.structs.asdict(entry).items()
        if value is not None
    }
