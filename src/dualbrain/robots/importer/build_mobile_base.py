"""Builds the `RobotModel` of a mobile base: speed limits from its wheels, shapes with all other joints fixed.

The rim of a wheel of radius r and maximum rate ω_w moves at most at r ω_w, so |v| + |ω| b/2 ≤ r ω_w with the track b.
The limits of v and ω are a box within this set: the speed that the site states, and the remainder for turning; if the
site states no speed, one half each. The same holds for the accelerations, of which both are stated, if the acceleration
of a wheel is known. The narrowest limit of a wheel holds: of the description, of all joints, or of [joint.WHEEL].
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.assets.mesh_primitives import CIRCLE_SEGMENTS, apply_pose, concatenate_meshes
from dualbrain.robots.assets.meshes import Mesh
from dualbrain.robots.collision_model.sphere_budget import FULL, QUICK, fit_links
from dualbrain.robots.differential_drive import make_differential_base
from dualbrain.robots.importer.build_arm import (
    ImportOptions,
    ImportResult,
    collision_spheres,
    make_report,
    to_identifier,
    unidentified_tracking,
)
from dualbrain.robots.importer.kinematic_chain import link_poses_at_rest
from dualbrain.robots.importer.kinematic_tree import KinematicTree, TreeJoint
from dualbrain.robots.importer.required_limits import (
    LimitPolicy,
    MissingLimit,
    MissingLimitsError,
    StatedLimit,
    described_limit,
    narrower_limit,
    refuse_unused_limits,
    robot_bound,
)
from dualbrain.robots.model import Bound, Link, RobotModel

Array = NDArray[np.float64]

AXIS_TOLERANCE = 1e-3
DRIVE, TURN = "drive", "turn"
"""Names of the joints of the model of a base, for [joint.NAME] of a site file."""
MAX_DRIVE_SHARE = 0.9
"""Largest share of the speed and of the acceleration of the rims for driving; the rest is for turning."""


def build_base(
    tree: KinematicTree,
    policy: LimitPolicy,
    options: ImportOptions,
    wheels: tuple[str, str] | None,
    report_progress: Callable[[str], None] = lambda _: None,
) -> ImportResult:
    """The robot model of a differential-drive base.

    `wheels` are the names of its left and right wheel joints; if they are given, the frame of the base is between them.

    Raises:
        MissingLimitsError: Speeds, accelerations or the control period are not stated.
        UnknownNameError: A limit of a joint that does not exist is stated.
        ConfigurationError: The wheels are not a pair on one axle across the base, a limit of a wheel is not above 0, or
            a limit is stated that the model of a base cannot keep: a jerk, a range, a grip force, or one of a fixed
            joint.
        MissingDependencyError: A mesh file or a library does not exist.
    """
    _refuse_unused_limits(tree, policy, wheels)
    root = tree.link(options.base).name if options.base else tree.root
    poses, locked = link_poses_at_rest(tree, root, options.lock)
    centre, track = find_axle(tree, poses, wheels)
    missing: list[MissingLimit] = []
    axle = _axle_limits(tree, policy, wheels, track, missing)
    speed, turn = _speed_limits(policy, axle, missing)
    acceleration, turning = _acceleration_limits(policy, axle, missing)
    period = robot_bound("period", "s", policy, missing)
    if missing:
        raise MissingLimitsError(tree.source, tuple(missing))
    meshes = base_meshes(tree, poses, centre)
    report_progress(f"mobile base with {len(meshes)} shapes; fitting spheres")
    shapes = {"base": meshes}
    fits = fit_links(shapes, {"base": 1.0}, options.sphere_budget, QUICK if options.quick else FULL, options.seed)
    without_spheres = make_differential_base(
        options.name or f"{to_identifier(tree.name)[:27]}_base",
        (),
        speed=speed,
        turn_rate=turn,
        acceleration=acceleration,
        turn_acceleration=turning,
        tracking=unidentified_tracking(),
        period=period.value,
        licence=tree.licence,
    )
    spheres = collision_spheres({"base": fits["base"].spheres})
    robot_model: RobotModel = msgspec.structs.replace(
        without_spheres, source=tree.source, spheres=spheres, base_lag=0.0
    )
    values = ", ".join(f"{name} = {value:g}" for name, value in locked.items())
    notes = (
        *tree.notes,
        f"control period {period.value:g} s: {period.provenance}",
        f"joints that are assumed to be fixed: {values}",
    )
    report = make_report((Link(name="base", frame=2, group="base"),), fits, notes, quick=options.quick)
    return ImportResult(robot_model, report, {"base": concatenate_meshes(meshes)})


def base_meshes(tree: KinematicTree, poses: Mapping[str, Array], centre: Array) -> list[Mesh]:
    """All meshes of the robot in the frame of the base; `centre` (4, 4) is the transform from `find_axle`."""
    return [
        apply_pose(shape.load_mesh(), centre @ poses[name])
        for name, link in tree.links.items()
        for shape in link.shapes
    ]


def find_axle(tree: KinematicTree, poses: Mapping[str, Array], wheels: tuple[str, str] | None) -> tuple[Array, float]:
    """The transform (4, 4) that moves the centre of the axle to the origin, and the track [m].

    Without `wheels` it is the identity, and the track is 0. Raises `ConfigurationError` as `build_base` does.
    """
    centre = np.eye(4)
    if wheels is None:
        return centre, 0.0
    left, right = (tree.joint(name) for name in wheels)
    positions = [(poses[joint.parent] @ joint.pose)[:3, 3] for joint in (left, right)]
    _check_axle(poses, left, right, positions)
    centre[:2, 3] = -0.5 * (positions[0] + positions[1])[:2]
    return centre, float(np.linalg.norm(positions[0] - positions[1]))


@dataclass(frozen=True, slots=True, kw_only=True)
class _AxleLimits:
    """The largest speed [m/s] and acceleration [m/s²] of the rims, None if not stated, and the `track` [m]."""

    speed: StatedLimit | None
    acceleration: StatedLimit | None
    track: float


def _refuse_unused_limits(tree: KinematicTree, policy: LimitPolicy, wheels: tuple[str, str] | None) -> None:
    """Raise for a stated limit that the model of a base does not keep."""
    refuse_unused_limits(policy.all_joints, {"jerk": "the model of a mobile base has no jerk limit"})
    no_gripper = "a mobile base has no gripper"
    refuse_unused_limits(policy.robot, {"grip_force": no_gripper, "grip_force_min": no_gripper})
    moving = {DRIVE, TURN, *(wheels or ())}
    known = tuple({*(joint.name for joint in tree.joints), *moving})
    for name, limits in policy.by_joint.items():
        if name not in known:
            raise UnknownNameError("joint", name, known, owner=tree.source)
        used = ("velocity", "acceleration") if name in moving else ()
        reason = f"the model of a mobile base keeps velocity and acceleration of {', '.join(sorted(moving))}"
        refuse_unused_limits(limits, {limit: reason for limit in limits if limit not in used}, f" of {name!r}")


def _axle_limits(
    tree: KinematicTree,
    policy: LimitPolicy,
    wheels: tuple[str, str] | None,
    track: float,
    missing: list[MissingLimit],
) -> _AxleLimits | None:
    """The limits of the rims of both wheels; None without `wheels`, or if the rate of a wheel is not stated."""
    if wheels is None:
        return None
    joints = [tree.joint(name) for name in wheels]
    rates = {joint.name: _wheel_limit(joint, "velocity", policy) for joint in joints}
    missing += [MissingLimit(name, "velocity") for name, rate in rates.items() if rate is None]
    if None in rates.values():
        return None
    accelerations = {joint.name: _wheel_limit(joint, "acceleration", policy) for joint in joints}
    radii = {joint.name: _wheel_radius(tree, joint) for joint in joints}
    speed, acceleration = _rim_limit(rates, radii, "m/s", track), _rim_limit(accelerations, radii, "m/s²", track)
    return _AxleLimits(speed=speed, acceleration=acceleration, track=track)


def _wheel_limit(joint: TreeJoint, name: str, policy: LimitPolicy) -> StatedLimit | None:
    """The narrowest stated limit of a wheel [rad/s, rad/s²].

    The acceleration for all joints does not count: it is that of the base along its path.
    """
    own = policy.by_joint.get(joint.name, {}).get(name)
    stated = policy.limit_of(joint.name, name) if name == "velocity" else own
    limit = narrower_limit(described_limit(joint, name), stated)
    if limit is not None and not limit.value > 0.0:
        raise ConfigurationError(f"{name} of {joint.name!r} ({limit.provenance})", got=limit.value, allowed="above 0")
    return limit


def _rim_limit(
    limits: Mapping[str, StatedLimit | None], radii: Mapping[str, float], unit: str, track: float
) -> StatedLimit | None:
    """The limit of the slower rim in `unit`, from limits of the wheels; None if neither has one."""
    rims = [(limit.value * radii[name], limit) for name, limit in limits.items() if limit is not None]
    if not rims:
        return None
    value, limit = min(rims, key=lambda rim: rim[0])
    return StatedLimit(value, f"{limit.provenance}: wheels reach {value:.3g} {unit} at their rims, track {track:.3g} m")


def _speed_limits(policy: LimitPolicy, axle: _AxleLimits | None, missing: list[MissingLimit]) -> tuple[Bound, Bound]:
    """The limits of speed and turn rate; extends `missing`."""
    if axle is not None and axle.speed is not None:
        half = StatedLimit(0.5 * axle.speed.value, f"half of the rim speed for driving; {axle.speed.provenance}")
        drive, turn = policy.robot.get("tool_speed") or half, policy.robot.get("turn")
    elif missing:  # the rate of a wheel
        return Bound(0.0, "m/s", "missing"), Bound(0.0, "rad/s", "missing")
    else:
        robot_bound("tool_speed", "m/s", policy, missing)
        robot_bound("turn", "rad/s", policy, missing)
        drive, turn = policy.robot.get("tool_speed"), policy.robot.get("turn")
    drive = narrower_limit(drive, policy.limit_of(DRIVE, "velocity"))
    turn = narrower_limit(turn, policy.limit_of(TURN, "velocity"))
    return _share_of_rim(drive, turn, axle and axle.speed, axle, ("m/s", "rad/s"))


def _acceleration_limits(
    policy: LimitPolicy, axle: _AxleLimits | None, missing: list[MissingLimit]
) -> tuple[Bound, Bound]:
    """The limits of the acceleration along the path and of the turn acceleration; extends `missing`."""
    drive = policy.limit_of(DRIVE, "acceleration")
    if drive is None:
        missing.append(MissingLimit("base", "acceleration"))
    robot_bound("turn_acceleration", "rad/s^2", policy, missing)
    own = policy.by_joint.get(TURN, {}).get("acceleration")
    turn = narrower_limit(policy.robot.get("turn_acceleration"), own)
    return _share_of_rim(drive, turn, axle and axle.acceleration, axle, ("m/s^2", "rad/s^2"))


def _share_of_rim(
    drive: StatedLimit | None,
    turn: StatedLimit | None,
    rim: StatedLimit | None,
    axle: _AxleLimits | None,
    units: tuple[str, str],
) -> tuple[Bound, Bound]:
    """The limits of driving and turning, of which the rims of the wheels can follow both together."""
    if rim is not None and axle is not None:
        most = StatedLimit(MAX_DRIVE_SHARE * rim.value, f"{MAX_DRIVE_SHARE:.0%} of the rims; {rim.provenance}")
        drive = most if drive is None or drive.value > most.value else drive
        left = StatedLimit((rim.value - drive.value) * 2.0 / axle.track, f"the rest of the rims; {rim.provenance}")
        turn = left if turn is None or turn.value > left.value else turn
    missing = StatedLimit(0.0, "missing")
    drive, turn = drive or missing, turn or missing
    return Bound(drive.value, units[0], drive.provenance), Bound(turn.value, units[1], turn.provenance)


def _check_axle(poses: Mapping[str, Array], left: TreeJoint, right: TreeJoint, positions: list[Array]) -> None:
    """Raise unless both wheels turn about one line across the base, at `positions` (3,) [m]."""
    across = positions[0] - positions[1]
    for joint in (left, right):
        axis = (poses[joint.parent] @ joint.pose)[:3, :3] @ joint.axis
        misaligned = (
            abs(axis[1]) < 1.0 - AXIS_TOLERANCE or abs(across[0]) > AXIS_TOLERANCE or abs(across[2]) > AXIS_TOLERANCE
        )
        if joint.kind not in ("continuous", "revolute") or misaligned or across[1] <= 0.0:
            raise ConfigurationError(
                f"wheels {left.name!r} and {right.name!r} ({joint.source_location})",
                got=[list(np.round(position, 4)) for position in positions],
                allowed="left and right of the base's x axis, turning about its y axis",
            )


def _wheel_radius(tree: KinematicTree, joint: TreeJoint) -> float:
    """Largest distance [m] of the shapes of the wheel on `joint` from its axis; a cylinder has its own radius."""
    vertices = [shape.load_mesh().vertices for shape in tree.links[joint.child].shapes]
    if not vertices:
        raise ConfigurationError.stating(
            f"The wheel {joint.child!r} ({joint.source_location}) has no shape, so its radius is unknown.",
            fix="Add a collision shape to the wheel, or state the speeds of the base without --wheels.",
        )
    points = np.vstack(vertices)
    radial = points - np.outer(points @ joint.axis, joint.axis)
    circumscribed = 1.0 / np.cos(np.pi / CIRCLE_SEGMENTS)  # the mesh of a cylinder contains it
    return float(np.linalg.norm(radial, axis=1).max() / circumscribed)
