"""The body of a base that drives: its speeds from its wheels, its shapes with the upper parts standing still.

A wheel of radius r that turns at most at ω_w moves at r ω_w, so |v| + |ω| b/2 ≤ r ω_w with the track b. The box of
(v, ω) lies inside: the site's speed first, the rest for turning; without a word of the site, half and half.
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
from dualbrain.robots.importer.required_limits import LimitPolicy, MissingLimit, MissingLimitsError, robot_bound
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
    """A differential base; `wheels` are its left and right wheel joints, between which its frame then lies.

    Raises:
        MissingLimits: speeds, accelerations or the control period are not stated.
        InvalidSetup: the wheels are not a pair on one axle across the base.
        MissingPart: a mesh or library is not there.
    """
    root = tree.link(options.base).name if options.base else tree.root
    poses, locked = link_poses_at_rest(tree, root, options.lock)
    centre, speed, turn, missing = _speed_limits(tree, poses, policy, wheels)
    acceleration = _acceleration_limit(policy, missing)
    turning = robot_bound("turn_acceleration", "rad/s^2", policy, missing)
    period = robot_bound("period", "s", policy, missing)
    if missing:
        raise MissingLimitsError(tree.source, tuple(missing))
    meshes = base_meshes(tree, poses, centre)
    report_progress(f"a base with {len(meshes)} shapes; fitting spheres")
    shapes = {"base": meshes}
    fits = fit_links(shapes, {"base": 1.0}, options.sphere_budget, QUICK if options.quick else FULL, options.seed)
    plain = make_differential_base(
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
    robot_model: RobotModel = msgspec.structs.replace(plain, source=tree.source, spheres=spheres, base_lag=0.0)
    stand = ", ".join(f"{name} = {value:g}" for name, value in locked.items())
    notes = (
        *tree.notes,
        f"control period {period.value:g} s: {period.provenance}",
        f"joints that stand still: {stand}",
    )
    report = make_report((Link(name="base", frame=2, group="base"),), fits, notes, quick=options.quick)
    return ImportResult(robot_model, report, {"base": concatenate_meshes(meshes)})


def base_meshes(tree: KinematicTree, poses: Mapping[str, Array], centre: Array) -> list[Mesh]:
    """Every shape of the robot in the frame of the base, whose axle `centre` (4, 4) brings to the origin."""
    return [
        apply_pose(piece.load_mesh(), centre @ poses[name])
        for name, link in tree.links.items()
        for piece in link.shapes
    ]


def find_axle(tree: KinematicTree, poses: Mapping[str, Array], wheels: tuple[str, str] | None) -> tuple[Array, float]:
    """The pose (4, 4) that brings the axle's middle to the origin, and the track [m]; raises as `build_base`."""
    centre = np.eye(4)
    if wheels is None:
        return centre, 0.0
    left, right = (tree.joint(name) for name in wheels)
    places = [(poses[joint.parent] @ joint.pose)[:3, 3] for joint in (left, right)]
    _check_axle(poses, left, right, places)
    centre[:2, 3] = -0.5 * (places[0] + places[1])[:2]
    return centre, float(np.linalg.norm(places[0] - places[1]))


def _acceleration_limit(policy: LimitPolicy, missing: list[MissingLimit]) -> Bound:
    given = policy.all_joints.get("acceleration")
    if given is None:
        missing.append(MissingLimit("base", "acceleration"))
        return Bound(0.0, "m/s^2", "missing")
    return Bound(given.value, "m/s^2", given.provenance)


def _speed_limits(
    tree: KinematicTree, poses: dict[str, Array], policy: LimitPolicy, wheels: tuple[str, str] | None
) -> tuple[Array, Bound, Bound, list[MissingLimit]]:
    """The pose (4, 4) that brings the axle's middle to the origin, speed, turn rate, and what is missing."""
    missing: list[MissingLimit] = []
    centre, track = find_axle(tree, poses, wheels)
    if wheels is None:
        speed = robot_bound("tool_speed", "m/s", policy, missing)
        return centre, speed, robot_bound("turn", "rad/s", policy, missing), missing
    left, right = (tree.joint(name) for name in wheels)
    rims = [_wheel_radius(tree, joint) * (joint.velocity or 0.0) for joint in (left, right)]
    rim = min(rims)
    if not rim > 0.0:
        missing.append(MissingLimit(left.name, "velocity"))
        return centre, Bound(0.0, "m/s", ""), Bound(0.0, "rad/s", ""), missing
    said = f"{left.source_location}: wheels reach {rim:.3g} m/s at their rims, track {track:.3g} m"
    asked, asked_turn = policy.robot.get("tool_speed"), policy.robot.get("turn")
    v = min(asked.value if asked else 0.5 * rim, 0.9 * rim)
    w = (rim - v) * 2.0 / track
    speed = Bound(v, "m/s", f"{asked.provenance if asked else 'half of it for driving'}; {said}")
    slower = asked_turn if asked_turn and asked_turn.value < w else None
    turn = Bound(
        slower.value if slower else w, "rad/s", f"{slower.provenance if slower else 'the rest for turning'}; {said}"
    )
    return centre, speed, turn, missing


def _check_axle(poses: Mapping[str, Array], left: TreeJoint, right: TreeJoint, places: list[Array]) -> None:
    """Raise unless both wheels turn about one line across the base."""
    across = places[0] - places[1]
    for joint in (left, right):
        axis = (poses[joint.parent] @ joint.pose)[:3, :3] @ joint.axis
        bent = abs(axis[1]) < 1.0 - AXIS_TOLERANCE or abs(across[0]) > AXIS_TOLERANCE or abs(across[2]) > AXIS_TOLERANCE
        if joint.kind not in ("continuous", "revolute") or bent or across[1] <= 0.0:
            raise ConfigurationError(
                f"wheels {left.name!r} and {right.name!r} ({joint.source_location})",
                got=[list(np.round(p, 4)) for p in places],
                allowed="left and right of the base's x axis, turning about its y axis",
            )


def _wheel_radius(tree: KinematicTree, joint: TreeJoint) -> float:
    """Greatest distance [m] of the wheel's shapes from its axis."""
    points = [piece.load_mesh().vertices for piece in tree.links[joint.child].shapes]
    if not points:
        raise ConfigurationError(
            f"wheel {joint.child!r} ({joint.source_location})", got="no shape", allowed="a shape with a radius"
        )
    off = np.vstack(points)
    off = off - np.outer(off @ joint.axis, joint.axis)
    return float(np.linalg.norm(off, axis=1).max())
