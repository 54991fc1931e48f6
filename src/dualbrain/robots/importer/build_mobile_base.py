"""Builds the `RobotModel` of a mobile base: speed limits from its wheels, shapes with all other joints fixed.

The rim of a wheel of radius r and maximum rate ω_w moves at most at r ω_w, so |v| + |ω| b/2 ≤ r ω_w with the track b.
The limits of v and ω are a box within this set: the speed that the site states, and the remainder for turning; if the
site states no speed, one half each.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError
from dualbrain.robots.assets.mesh_primitives import apply_pose, concatenate_meshes
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
    refuse_unused_limits,
    robot_bound,
)
from dualbrain.robots.model import Bound, Link, RobotModel

Array = NDArray[np.float64]

AXIS_TOLERANCE = 1e-3


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
        ConfigurationError: The wheels are not a pair on one axle across the base, or a jerk limit is stated.
        MissingDependencyError: A mesh file or a library does not exist.
    """
    refuse_unused_limits(policy.all_joints, {"jerk": "the model of a mobile base has no jerk limit"})
    root = tree.link(options.base).name if options.base else tree.root
    poses, locked = link_poses_at_rest(tree, root, options.lock)
    centre, speed, turn, missing = _speed_limits(tree, poses, policy, wheels)
    acceleration = _acceleration_limit(policy, missing)
    turning = robot_bound("turn_acceleration", "rad/s^2", policy, missing)
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


def _acceleration_limit(policy: LimitPolicy, missing: list[MissingLimit]) -> Bound:
    stated = policy.all_joints.get("acceleration")
    if stated is None:
        missing.append(MissingLimit("base", "acceleration"))
        return Bound(0.0, "m/s^2", "missing")
    return Bound(stated.value, "m/s^2", stated.provenance)


def _speed_limits(
    tree: KinematicTree, poses: dict[str, Array], policy: LimitPolicy, wheels: tuple[str, str] | None
) -> tuple[Array, Bound, Bound, list[MissingLimit]]:
    """The transform (4, 4) of `find_axle`, the limits of speed and turn rate, and the missing limits."""
    missing: list[MissingLimit] = []
    centre, track = find_axle(tree, poses, wheels)
    if wheels is None:
        speed = robot_bound("tool_speed", "m/s", policy, missing)
        return centre, speed, robot_bound("turn", "rad/s", policy, missing), missing
    left, right = (tree.joint(name) for name in wheels)
    rim_speed = min(_wheel_radius(tree, joint) * (joint.velocity or 0.0) for joint in (left, right))
    if not rim_speed > 0.0:
        missing.append(MissingLimit(left.name, "velocity"))
        return centre, Bound(0.0, "m/s", ""), Bound(0.0, "rad/s", ""), missing
    source = f"{left.source_location}: wheels reach {rim_speed:.3g} m/s at their rims, track {track:.3g} m"
    stated, stated_turn = policy.robot.get("tool_speed"), policy.robot.get("turn")
    v = min(stated.value if stated else 0.5 * rim_speed, 0.9 * rim_speed)
    w = (rim_speed - v) * 2.0 / track
    speed = Bound(v, "m/s", f"{stated.provenance if stated else 'half of the rim speed for driving'}; {source}")
    slower = stated_turn if stated_turn and stated_turn.value < w else None
    turn = Bound(
        slower.value if slower else w,
        "rad/s",
        f"{slower.provenance if slower else 'the rest of the rim speed for turning'}; {source}",
    )
    return centre, speed, turn, missing


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
    """Largest distance [m] of the shapes of the wheel on `joint` from its axis."""
    vertices = [shape.load_mesh().vertices for shape in tree.links[joint.child].shapes]
    if not vertices:
        raise ConfigurationError.stating(
            f"The wheel {joint.child!r} ({joint.source_location}) has no shape, so its radius is unknown.",
            fix="Add a collision shape to the wheel, or state the speeds of the base without --wheels.",
        )
    points = np.vstack(vertices)
    radial = points - np.outer(points @ joint.axis, joint.axis)
    return float(np.linalg.norm(radial, axis=1).max())
