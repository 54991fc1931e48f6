"""Application of a site file: the derated robot model, the fixed obstacles, and the filter with both."""

from __future__ import annotations

from collections.abc import Iterator
from math import cos, sin

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import matrix_to_quaternion, quaternion_to_matrix
from dualbrain.core.geometry.shapes import Box, Pose
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.model import Bound, CollisionSphere, Joint, Link, RobotModel, SelfCollisionPairs, Tool
from dualbrain.robots.site_config import OWN_REGION, PersonEntry, SiteError, SiteFile, ToolEntry, ToolSphere
from dualbrain.safety.barriers.workspace import plane
from dualbrain.safety.cbf.config import FilterConfig, operating_config
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import NearSpeed, Obstacle, PersonLimits, SpeedAndSeparation
from dualbrain.safety.cbf.rows import Rank
from dualbrain.safety.integration.power_and_force import BodyRegion, body_region, contact_speed, effective_mass

TOOL_LINK, PAYLOAD_LINK = "site_tool", "site_payload"
Array = NDArray[np.float64]
GRIPPER_GROUPS = ("hand", "fingers")


def site_filter(file: SiteFile, robot_model: RobotModel, config: FilterConfig | None = None) -> SafetyFilter:
    """Filter of `robot_model` at this site, with its limits, tool, payload, planes and keep-out boxes.

    Without `config` it is the `operating_config`, which limits the speed of all parts to the tool speed of the site.
    The limits near persons are those of the obstacles: pass `site_persons` to `obstacles_from_scene`.

    Raises:
        SiteError: an entry does not fit the robot model; the error has its line and column.
    """
    narrowed = site_robot(robot_model, file)
    chosen = operating_config(narrowed) if config is None else config
    return SafetyFilter(narrowed, chosen, obstacles=site_obstacles(narrowed, file))


def site_robot(robot_model: RobotModel, file: SiteFile) -> RobotModel:
    """`robot_model` with the limits of the site (which only narrow), its control period, tool and payload.

    The tool speed also limits the speed of a mobile base along its path, `turn` and `turn_acceleration` its turning.

    Raises:
        SiteError: an entry does not fit the robot model, or nothing of this robot uses it.
    """
    site = file.site
    known = {joint.name for joint in robot_model.joints}
    for name in site.joint:
        if name not in known:
            raise file.make_error(
                f"joint.{name}", got=name, allowed=f"a joint of {robot_model.name}: {', '.join(sorted(known))}"
            )
    _refuse_unused_limits(robot_model, file)
    joints = tuple(_limit_joint(joint, file) for joint in robot_model.joints)
    if robot_model.is_mobile:
        joints = _limit_base(joints, file)
    speed = _narrow_bound(robot_model.tool_speed, site.robot.tool_speed, file, "robot.tool_speed")
    period = robot_model.period if site.robot.period is None else site.robot.period
    changed = msgspec.structs.replace(robot_model, joints=joints, tool_speed=speed, period=period)
    for name, tool_spheres, error in _carried_spheres(file):
        changed = _with_link(changed, name, tool_spheres, error)
    return changed if site.tool is None else _with_tool_tip(changed, site.tool)


def site_obstacles(robot_model: RobotModel, file: SiteFile) -> tuple[Obstacle, ...]:
    """Planes and keep-out boxes of the site. They are known to φ, and their rows are relaxed before those of obstacles.

    Raises:
        SiteError: a plane names an unknown part or has a zero normal.
    """
    parts = {link.name for link in robot_model.links} | {link.group for link in robot_model.links} | {"held"}
    found: list[Obstacle] = []
    for index, entry in enumerate(file.site.plane):
        for name in entry.parts:
            if name not in parts:
                allowed = f"parts of {robot_model.name}: {', '.join(sorted(parts))}"
                raise file.make_error(f"plane[{index}].parts", got=name, allowed=allowed)
        if not any(entry.inward):
            raise file.make_error(f"plane[{index}].inward", got=entry.inward, allowed="a vector that is not zero")
        found.append(plane(entry.name, entry.point, entry.inward, parts=entry.parts, margin=entry.margin))
    for entry in file.site.keep_out:
        rotation = (cos(0.5 * entry.yaw), 0.0, 0.0, sin(0.5 * entry.yaw))
        found.append(
            Obstacle(
                name=entry.name,
                shape=Box(entry.half_extents),
                pose=Pose(entry.position, rotation),
                margin=entry.margin,
                rank=Rank.WORKSPACE,
                known=True,
                barrier="keep_out",
            )
        )
    return tuple(found)


def site_persons(file: SiteFile) -> PersonLimits | None:
    """The speed limits near persons; None if the file has no entry for any.

    Raises:
        SiteError: an entry lacks a number, names an unknown body region, or its contact speed is not usable.
    """
    separation: dict[str, SpeedAndSeparation] = {}
    near: dict[str, NearSpeed] = {}
    for name, entry in file.site.person.items():
        path = f"person.{name}"
        try:
            if entry.monitoring == "separation":
                separation[name] = _separation(entry)
            elif entry.monitoring == "power_and_force":
                near[name] = _near_speed(entry, file, path)
        except SiteError:
            raise
        except (ConfigurationError, UnknownNameError) as error:
            got = entry.body_region or entry.monitoring
            raise file.make_error(path, got=got, allowed="", sentence=f"[{path}]: {error}") from error
    names = frozenset(file.site.person)
    return PersonLimits(separation=separation, near=near, named=names) if names else None


def _separation(entry: PersonEntry) -> SpeedAndSeparation:
    default = SpeedAndSeparation()
    return SpeedAndSeparation(
        default.reaction if entry.reaction is None else entry.reaction,
        default.brake if entry.brake is None else entry.brake,
        default.approach if entry.approach is None else entry.approach,
    )


def _near_speed(entry: PersonEntry, file: SiteFile, path: str) -> NearSpeed:
    """The power and force limiting of one person: the contact speed minus the assumed speed of the person."""
    moving = file.site.robot.moving_mass
    if moving is None:
        raise file.make_error(path, got="no [robot] moving_mass", allowed="the mass of the moving parts [kg]")
    region = _own_region(entry, file, path) if entry.body_region == OWN_REGION else body_region(entry.body_region or "")
    mass = effective_mass(moving, file.site.robot.load)
    speed = contact_speed(region, mass, pressure=entry.pressure, area=entry.area)
    approach = 0.0 if entry.approach is None else entry.approach
    distance = 0.3 if entry.distance is None else entry.distance
    return NearSpeed(speed - approach, distance, 1.0 if entry.brake is None else entry.brake, approach)


def _own_region(entry: PersonEntry, file: SiteFile, path: str) -> BodyRegion:
    """The body region with the numbers of the site."""
    mass, stiffness, force, source = entry.mass, entry.stiffness, entry.force, entry.source
    if mass is None or stiffness is None or force is None or not source:
        got = f"mass {mass}, stiffness {stiffness}, force {force}, source {source!r}"
        raise file.make_error(path, got=got, allowed="mass, stiffness, force and their source")
    return BodyRegion(mass=mass, stiffness=stiffness, force=force, transient=entry.transient, source=source)


def site_skill_grants(file: SiteFile, skills: frozenset[str]) -> dict[str, frozenset[str]] | None:
    """Skills that each commander may call, by commander; None if the file grants no commander anything.

    Raises:
        SiteError: the file names a skill that this robot does not have.
    """
    for name, commander in file.site.commander.items():
        for skill in commander.skills:
            if skill not in skills:
                raise file.make_error(f"commander.{name}.skills", got=skill, allowed=", ".join(sorted(skills)))
    return {name: frozenset(entry.skills) for name, entry in file.site.commander.items()} or None


def _refuse_unused_limits(robot_model: RobotModel, file: SiteFile) -> None:
    """Raise `SiteError` for a limit of a kind that no joint of the robot has: nothing would keep it."""
    name, site = robot_model.name, file.site
    if not robot_model.is_mobile:
        for entry in ("turn", "turn_acceleration"):
            if (value := getattr(site.robot, entry)) is not None:
                allowed = f"an entry for a mobile base; {name} has none, so leave it out"
                raise file.make_error(f"robot.{entry}", got=value, allowed=allowed)
    without = [joint.name for joint in robot_model.joints if joint.jerk is None]
    jerks = {f"joint.{joint}": site.joint[joint].jerk for joint in without if joint in site.joint}
    if len(without) == robot_model.n:
        jerks["limits"] = site.limits.jerk
    for path, jerk in jerks.items():
        if jerk is not None:
            allowed = f"no entry: the model of {name} has no limit of the jerk there that a site could narrow"
            raise file.make_error(f"{path}.jerk", got=jerk, allowed=allowed)


def _limit_base(joints: tuple[Joint, ...], file: SiteFile) -> tuple[Joint, ...]:
    """`joints` whose first two, driving and turning of a base, have the speed and turn limits of [robot]."""
    drive, turn, *others = joints
    drive = _limit_side(drive, "velocity", file.site.robot.tool_speed, file, "robot.tool_speed")
    turn = _limit_side(turn, "velocity", file.site.robot.turn, file, "robot.turn")
    turn = _limit_side(turn, "acceleration", file.site.robot.turn_acceleration, file, "robot.turn_acceleration")
    return (drive, turn, *others)


def _limit_joint(joint: Joint, file: SiteFile) -> Joint:
    """A joint with the limits for all joints and its own limits applied."""
    own, common = file.site.joint.get(joint.name), file.site.limits
    for side in ("velocity", "acceleration", "jerk"):
        joint = _limit_side(joint, side, getattr(common, side), file, f"limits.{side}")
        joint = _limit_side(joint, side, getattr(own, side) if own else None, file, f"joint.{joint.name}.{side}")
    for side in ("lower", "upper"):
        joint = _limit_side(joint, side, getattr(own, side) if own else None, file, f"joint.{joint.name}.{side}")
    if not joint.lower.value < joint.upper.value:
        got = [joint.lower.value, joint.upper.value]
        raise file.make_error(f"joint.{joint.name}", got=got, allowed="a range that is not empty")
    return joint


def _limit_side(joint: Joint, side: str, value: float | None, file: SiteFile, path: str) -> Joint:
    bound: Bound | None = getattr(joint, side)
    if value is None or bound is None:
        return joint
    return msgspec.structs.replace(joint, **{side: _narrow_bound(bound, value, file, path, lower=side == "lower")})


def _narrow_bound(bound: Bound, value: float | None, file: SiteFile, path: str, *, lower: bool = False) -> Bound:
    if value is None or (value <= bound.value if lower else value >= bound.value):
        return bound
    return Bound(value, bound.unit, f"site policy ({file.locate(path)}); wider: {bound.value:g} of {bound.provenance}")


def _carried_spheres(file: SiteFile) -> Iterator[tuple[str, tuple[ToolSphere, ...], float]]:
    """Objects that stay attached to the hand: link name, spheres, position error [m]."""
    if file.site.tool and file.site.tool.spheres:
        yield TOOL_LINK, file.site.tool.spheres, 0.0
    if file.site.payload:
        yield PAYLOAD_LINK, file.site.payload.spheres, file.site.payload.error


def _with_link(robot_model: RobotModel, name: str, tool_spheres: tuple[ToolSphere, ...], error: float) -> RobotModel:
    """`robot_model` with a link for spheres in the tool frame; it keeps away from the same links as the hand."""
    link = next(link for link in robot_model.links if link.name == robot_model.tool.link)
    turn, origin = quaternion_to_matrix(robot_model.tool.quaternion), np.array(robot_model.tool.translation)
    spheres = tuple(
        CollisionSphere(name, _vector(origin + turn @ np.array(sphere.centre)), sphere.radius + error)
        for sphere in tool_spheres
    )
    frames = {link.name: link.frame for link in robot_model.links}
    near = {
        part
        for pair in robot_model.self_pairs.kept
        if _involves_gripper(robot_model, pair)
        for part in pair
        if frames[part] < robot_model.n
    }
    kept = (*robot_model.self_pairs.kept, *((part, name) for part in sorted(near)))
    return msgspec.structs.replace(
        robot_model,
        links=(
            *robot_model.links,
            Link(name=name, frame=link.frame, group="hand", translation=link.translation, quaternion=link.quaternion),
        ),
        spheres=(*robot_model.spheres, *spheres),
        self_pairs=SelfCollisionPairs(kept, robot_model.self_pairs.allowed),
    )


def _with_tool_tip(robot_model: RobotModel, tool: ToolEntry) -> RobotModel:
    """`robot_model` with the tool frame moved to the tip of the tool."""
    turn = quaternion_to_matrix(robot_model.tool.quaternion)
    tip = np.array(robot_model.tool.translation) + turn @ np.array(tool.position)
    placed = Tool(
        robot_model.tool.link, _vector(tip), matrix_to_quaternion(turn @ quaternion_to_matrix(tool.quaternion))
    )
    return msgspec.structs.replace(robot_model, tool=placed)


def _involves_gripper(robot_model: RobotModel, pair: tuple[str, str]) -> bool:
    return any(link.group in GRIPPER_GROUPS for link in robot_model.links if link.name in pair)


def _vector(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return (x, y, z)
