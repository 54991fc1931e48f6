"""Limits that a description often leaves out and a site must state: accelerations, control period, speeds.

No limit has a default. Where both the description and the site state a limit, the narrower one holds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite

import msgspec

from dualbrain.core.text import count_noun
from dualbrain.errors import ConfigurationError, UsageError
from dualbrain.robots.importer.kinematic_tree import TreeJoint
from dualbrain.robots.model import Bound
from dualbrain.robots.site_config import SiteFile

CONTINUOUS_JOINT_RANGE = 50.0
"""Range [rad] of a continuous joint: ±8 turns, in which float32 still resolves 4 µrad."""

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
    """One limit that a user stated, with its source: "site policy (lab.toml:7)" or "site policy (--acceleration)"."""

    value: float
    provenance: str


@dataclass(frozen=True, slots=True)
class LimitPolicy:
    """The limits that a site states: for all joints, for single joints by name, and for the whole robot."""

    all_joints: Mapping[str, StatedLimit] = field(default_factory=dict[str, StatedLimit])
    by_joint: Mapping[str, Mapping[str, StatedLimit]] = field(default_factory=dict[str, Mapping[str, StatedLimit]])
    robot: Mapping[str, StatedLimit] = field(default_factory=dict[str, StatedLimit])

    def limit_of(self, joint: str, name: str) -> StatedLimit | None:
        """The stated limit `name` of `joint`: of its own and that for all joints, the narrower one."""
        return narrower_limit(self.by_joint.get(joint, {}).get(name), self.all_joints.get(name))


@dataclass(frozen=True, slots=True)
class MissingLimit:
    """A limit that neither the description nor the site states."""

    owner: str
    limit: str

    def __str__(self) -> str:
        return f"{self.owner}: give {FIX_HINTS[self.limit].replace('NAME', self.owner.partition(':')[0])}"


class MissingLimitsError(ConfigurationError):
    """Limits that neither the description nor the site states; `missing` has all of them."""

    def __init__(self, source: str, missing: tuple[MissingLimit, ...]) -> None:
        """Report every missing limit of the description `source`."""
        self.missing = missing
        lines = "\n  ".join(_group_by_limit(missing))
        super().__init__(
            f"limits of {source}",
            got=f"{len(missing)} missing",
            allowed="each stated by the file or by the site",
            fix=f"No limit is assumed. State these limits:\n  {lines}",
            sentence=f"{count_noun(len(missing), 'limit')} of {source} {'is' if len(missing) == 1 else 'are'} missing.",
        )


def _group_by_limit(missing: tuple[MissingLimit, ...]) -> list[str]:
    """One line for each kind of limit, with the joints that lack it."""
    lines: list[str] = []
    for limit in dict.fromkeys(one.limit for one in missing):
        owners = [one.owner for one in missing if one.limit == limit]
        shown = ", ".join(owners[:8]) + (f" and {len(owners) - 8} more" if len(owners) > 8 else "")
        lines.append(f"{limit.replace('_', ' ')} ({shown}): {FIX_HINTS[limit]}")
    return lines


def joint_bounds(joint: TreeJoint, policy: LimitPolicy, missing: list[MissingLimit]) -> dict[str, Bound | None]:
    """Lower, upper, velocity, acceleration and jerk of a joint, with the provenance of each; extends `missing`.

    If both the description and the site state a bound, the narrower one holds, and its provenance names the other.

    Raises:
        ConfigurationError: A range is empty, or a velocity, acceleration or jerk is not above zero.
    """
    unit = "m" if joint.kind == "prismatic" else "rad"
    units = {
        "lower": unit,
        "upper": unit,
        "velocity": f"{unit}/s",
        "acceleration": f"{unit}/s^2",
        "jerk": f"{unit}/s^3",
    }
    bounds = {
        name: _narrower_bound(name, described_limit(joint, name), policy.limit_of(joint.name, name), units[name])
        for name in LIMIT_NAMES
    }
    for name in LIMIT_NAMES[:4]:
        if bounds[name] is None:
            missing.append(MissingLimit(joint.name, name))
    for name in LIMIT_NAMES[2:]:
        bound = bounds[name]
        if bound is not None and not bound.value > 0.0:
            raise ConfigurationError(
                f"{name} of {joint.name!r} ({bound.provenance})", got=bound.value, allowed="above 0"
            )
    lower, upper = bounds["lower"], bounds["upper"]
    if lower is not None and upper is not None and not lower.value < upper.value:
        raise ConfigurationError(
            f"range of {joint.name!r} ({lower.provenance}; {upper.provenance})",
            got=[lower.value, upper.value],
            allowed="lower below upper",
        )
    return bounds


def described_limit(joint: TreeJoint, name: str) -> StatedLimit | None:
    """The limit `name` of the description, None if it states none; of a range and a soft range, the narrower end."""
    hard, soft = _hard_limit(joint, name), _soft_limit(joint, name)
    if hard is None or soft is None:
        return hard or soft
    return _beside(soft, hard) if _is_narrower(name, soft, hard) else hard


def _soft_limit(joint: TreeJoint, name: str) -> StatedLimit | None:
    value = {"lower": joint.soft_lower, "upper": joint.soft_upper}.get(name)
    provenance = f"{joint.soft_location}: {joint.name} safety_controller soft_{name}_limit"
    return None if value is None else StatedLimit(value, provenance)


def _hard_limit(joint: TreeJoint, name: str) -> StatedLimit | None:
    """The limit `name` of the joint itself; a velocity of zero counts as not stated."""
    value: float | None = getattr(joint, name)
    if joint.kind == "continuous" and name in ("lower", "upper"):
        provenance = (
            f"{joint.source_location}: continuous, no limit; turns are counted within ±{CONTINUOUS_JOINT_RANGE:g} rad"
        )
        return StatedLimit(-CONTINUOUS_JOINT_RANGE if name == "lower" else CONTINUOUS_JOINT_RANGE, provenance)
    if value is None or (name == "velocity" and value <= 0.0):
        return None
    return StatedLimit(value, f"{joint.source_location}: {joint.name} limit {name}")


def _narrower_bound(name: str, described: StatedLimit | None, site: StatedLimit | None, unit: str) -> Bound | None:
    if described is None and site is None:
        return None
    if described is None or site is None:
        only = described or site
        assert only is not None
        return Bound(only.value, unit, only.provenance)
    found = _beside(site, described) if _is_narrower(name, site, described) else _beside(described, site)
    return Bound(found.value, unit, found.provenance)


def _is_narrower(name: str, one: StatedLimit, other: StatedLimit) -> bool:
    """Whether the limit `one` called `name` excludes values that `other` admits."""
    return one.value > other.value if name == "lower" else one.value < other.value


def robot_bound(name: str, unit: str, policy: LimitPolicy, missing: list[MissingLimit]) -> Bound:
    """A bound of the whole robot (tool speed, period); if it is not stated, the bound is 0 and `missing` is extended.

    Raises:
        ConfigurationError: The stated value is not above zero.
    """
    stated = policy.robot.get(name)
    if stated is None:
        missing.append(MissingLimit("robot", name))
        return Bound(0.0, unit, "missing")
    if not stated.value > 0.0:
        raise ConfigurationError(f"{name} ({stated.provenance})", got=stated.value, allowed="above 0")
    return Bound(stated.value, unit, stated.provenance)


def refuse_unused_limits(limits: Mapping[str, StatedLimit], unused: Mapping[str, str], owner: str = "") -> None:
    """Raise `ConfigurationError` for a stated limit that nothing of the robot keeps.

    `unused` are names with reasons; `owner` follows the name in the message (" of 'elbow'").
    """
    for name, reason in unused.items():
        if (stated := limits.get(name)) is not None:
            where = f"{name}{owner} ({stated.provenance})"
            raise ConfigurationError(where, got=stated.value, allowed=f"no entry: {reason}", fix="Leave it out.")


ROBOT_LIMIT_NAMES = ("period", "tool_speed", "turn", "turn_acceleration", "grip_force", "grip_force_min")


def make_limit_policy(file: SiteFile | None, options: Mapping[str, float | None]) -> LimitPolicy:
    """The limits in the site file and in `options` (acceleration, velocity, period, …): of two, the narrower holds.

    Raises:
        UsageError: an option is not above 0, or states another control period than the site file.
    """
    stated = {name: _option_limit(name, value) for name, value in options.items() if value is not None}
    all_joints = {name: stated[name] for name in ("velocity", "acceleration", "jerk") if name in stated}
    robot = {name: stated[name] for name in ROBOT_LIMIT_NAMES if name in stated}
    if file is None:
        return LimitPolicy(all_joints, {}, robot)
    site = file.site
    common = _narrowest(all_joints, _stated_limits(file, site.limits, "limits"))
    by_joint = {name: _stated_limits(file, caps, f"joint.{name}") for name, caps in site.joint.items()}
    whole = _stated_limits(file, site.robot, "robot")
    if "period" in robot and whole.get("period", robot["period"]).value != robot["period"].value:
        allowed = f"{whole['period'].value:g} s, as {file.locate('robot.period')} states, or no option"
        raise UsageError("--period", got=robot["period"].value, allowed=allowed)
    return LimitPolicy(common, by_joint, _narrowest(robot, whole))


def _option_limit(name: str, value: float) -> StatedLimit:
    """The limit that an option states; raises `UsageError` for a value that is no limit."""
    option = _option_name(name)
    if not (isfinite(value) and value > 0.0):
        raise UsageError(option, got=value, allowed="a finite number above 0")
    return StatedLimit(value, f"site policy ({option})")


def _narrowest(first: Mapping[str, StatedLimit], second: Mapping[str, StatedLimit]) -> dict[str, StatedLimit]:
    """The limits of both, by name; of two for the same quantity, the smaller one."""
    common = {name: _smaller(limit, second[name]) for name, limit in first.items() if name in second}
    return {**first, **second, **common}


def narrower_limit(one: StatedLimit | None, other: StatedLimit | None) -> StatedLimit | None:
    """The smaller of two upper limits, as far as they are stated."""
    return one or other if one is None or other is None else _smaller(one, other)


def _smaller(one: StatedLimit, other: StatedLimit) -> StatedLimit:
    """The smaller of two upper limits, whose provenance names the other one; the first of two equal ones."""
    narrow, wide = (one, other) if one.value <= other.value else (other, one)
    return narrow if one.value == other.value else _beside(narrow, wide)


def _beside(narrow: StatedLimit, wide: StatedLimit) -> StatedLimit:
    return StatedLimit(narrow.value, f"{narrow.provenance}; wider: {wide.value:g} of {wide.provenance}")


def _option_name(key: str) -> str:
    return "--grip" if key.startswith("grip") else f"--{key.replace('_', '-')}"


def _stated_limits(file: SiteFile, entry: msgspec.Struct, path: str) -> dict[str, StatedLimit]:
    """The stated limits of the `entry` at `path` of the site file."""
    return {
        name: StatedLimit(float(value), f"site policy ({file.locate(f'{path}.{name}')})")
        for name, value in msgspec.structs.asdict(entry).items()
        if value is not None
    }
