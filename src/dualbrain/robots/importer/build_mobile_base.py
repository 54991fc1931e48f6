"""The body of a base that drives: its speeds from its wheels, its shapes with the upper parts standing still.

A wheel of radius r that turns at most at ω_w moves at r ω_w, so |v| + |ω| b/2 ≤ r ω_w with the track b. The box of
(v, ω) lies inside: the site's speed first, the rest for turning; without a word of the site, half and half.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import InvalidSetup
from dualbrain.robots.assets.mesh_primitives import joined, moved
from dualbrain.robots.assets.meshes import Mesh
from dualbrain.robots.collision_model.sphere_budget import FULL, QUICK, fit_all
from dualbrain.robots.differential_drive import differential_base
from dualbrain.robots.importer.build_arm import Made, Wish, identifier, not_identified, report_of, spheres_of
from dualbrain.robots.importer.kinematic_chain import standing
from dualbrain.robots.importer.kinematic_tree import Tree, TreeJoint
from dualbrain.robots.importer.required_limits import Missing, MissingLimits, Policy, whole_bound
from dualbrain.robots.model import Body, Bound, Link

Array = NDArray[np.float64]

UPRIGHT = 1e-3


def build_base(
    tree: Tree, policy: Policy, wish: Wish, wheels: tuple[str, str] | None, tell: Callable[[str], None] = lambda _: None
) -> Made:  # fmt: skip
    """A differential base; `wheels` are its left and right wheel joints, between which its frame then lies.

    Raises:
        MissingLimits: speeds, accelerations or the control period are not stated.
        InvalidSetup: the wheels are not a pair on one axle across the base.
        MissingPart: a mesh or library is not there.
    """
    root = tree.link(wish.base).name if wish.base else tree.root
    poses, locked = standing(tree, root, wish.lock)
    centre, speed, turn, missing = _speeds(tree, poses, policy, wheels)
    acceleration = _acceleration(policy, missing)
    turning = whole_bound("turn_acceleration", "rad/s^2", policy, missing)
    period = whole_bound("period", "s", policy, missing)
    if missing:
        raise MissingLimits(tree.source, tuple(missing))
    meshes = base_shapes(tree, poses, centre)
    tell(f"a base with {len(meshes)} shapes; fitting spheres")
    shapes = {"base": meshes}
    fits = fit_all(shapes, {"base": 1.0}, wish.spheres, QUICK if wish.quick else FULL, wish.seed)
    plain = differential_base(
        wish.name or f"{identifier(tree.name)[:27]}_base", (), speed=speed, turn=turn, acceleration=acceleration,
        turn_acceleration=turning, tracking=not_identified(), period=period.value, licence=tree.licence,
    )  # fmt: skip
    spheres = spheres_of({"base": fits["base"].balls})
    body: Body = msgspec.structs.replace(plain, source=tree.source, spheres=spheres, base_lag=0.0)
    stand = ", ".join(f"{name} = {value:g}" for name, value in locked.items())
    notes = (
        *tree.notes,
        f"control period {period.value:g} s: {period.provenance}",
        f"joints that stand still: {stand}",
    )
    report = report_of((Link("base", 2, "base"),), fits, notes, quick=wish.quick)
    return Made(body, report, {"base": joined(meshes)})


def base_shapes(tree: Tree, poses: Mapping[str, Array], centre: Array) -> list[Mesh]:
    """Every shape of the robot in the frame of the base, whose axle `centre` (4, 4) brings to the origin."""
    return [moved(piece.load(), centre @ poses[name]) for name, link in tree.links.items() for piece in link.pieces]


def axle(tree: Tree, poses: Mapping[str, Array], wheels: tuple[str, str] | None) -> tuple[Array, float]:
    """The pose (4, 4) that brings the axle's middle to the origin, and the track [m]; raises as `build_base`."""
    centre = np.eye(4)
    if wheels is None:
        return centre, 0.0
    left, right = (tree.joint(name) for name in wheels)
    places = [(poses[joint.parent] @ joint.pose)[:3, 3] for joint in (left, right)]
    _one_axle(poses, left, right, places)
    centre[:2, 3] = -0.5 * (places[0] + places[1])[:2]
    return centre, float(np.linalg.norm(places[0] - places[1]))


def _acceleration(policy: Policy, missing: list[Missing]) -> Bound:
    given = policy.every.get("acceleration")
    if given is None:
        missing.append(Missing("base", "acceleration"))
        return Bound(0.0, "m/s^2", "missing")
    return Bound(given.value, "m/s^2", given.provenance)


def _speeds(
    tree: Tree, poses: dict[str, Array], policy: Policy, wheels: tuple[str, str] | None
) -> tuple[Array, Bound, Bound, list[Missing]]:
    """The pose (4, 4) that brings the axle's middle to the origin, speed, turn rate, and what is missing."""
    missing: list[Missing] = []
    centre, track = axle(tree, poses, wheels)
    if wheels is None:
        speed = whole_bound("tool_speed", "m/s", policy, missing)
        return centre, speed, whole_bound("turn", "rad/s", policy, missing), missing
    left, right = (tree.joint(name) for name in wheels)
    rims = [_radius(tree, joint) * (joint.velocity or 0.0) for joint in (left, right)]
    rim = min(rims)
    if not rim > 0.0:
        missing.append(Missing(left.name, "velocity"))
        return centre, Bound(0.0, "m/s", ""), Bound(0.0, "rad/s", ""), missing
    said = f"{left.where}: wheels reach {rim:.3g} m/s at their rims, track {track:.3g} m"
    asked, asked_turn = policy.robot.get("tool_speed"), policy.robot.get("turn")
    v = min(asked.value if asked else 0.5 * rim, 0.9 * rim)
    w = (rim - v) * 2.0 / track
    speed = Bound(v, "m/s", f"{asked.provenance if asked else 'half of it for driving'}; {said}")
    slower = asked_turn if asked_turn and asked_turn.value < w else None
    turn = Bound(
        slower.value if slower else w, "rad/s", f"{slower.provenance if slower else 'the rest for turning'}; {said}"
    )
    return centre, speed, turn, missing


def _one_axle(poses: Mapping[str, Array], left: TreeJoint, right: TreeJoint, places: list[Array]) -> None:
    """Raise unless both wheels turn about one line across the base."""
    across = places[0] - places[1]
    for joint in (left, right):
        axis = (poses[joint.parent] @ joint.pose)[:3, :3] @ joint.axis
        bent = abs(axis[1]) < 1.0 - UPRIGHT or abs(across[0]) > UPRIGHT or abs(across[2]) > UPRIGHT
        if joint.kind not in ("continuous", "revolute") or bent or across[1] <= 0.0:
            raise InvalidSetup(
                f"wheels {left.name!r} and {right.name!r} ({joint.where})", got=[list(np.round(p, 4)) for p in places],
                allowed="left and right of the base's x axis, turning about its y axis",
            )  # fmt: skip


def _radius(tree: Tree, joint: TreeJoint) -> float:
    """Greatest distance [m] of the wheel's shapes from its axis."""
    points = [piece.load().vertices for piece in tree.links[joint.child].pieces]
    if not points:
        raise InvalidSetup(f"wheel {joint.child!r} ({joint.where})", got="no shape", allowed="a shape with a radius")
    off = np.vstack(points)
    off = off - np.outer(off @ joint.axis, joint.axis)
    return float(np.linalg.norm(off, axis=1).max())
