"""The gripper at the end of a chain, where the description tells it: two fingers that slide apart on one line.

Told are: the fingers' way (range of their joints), their greatest force (effort of the joints, or the site's word), and
from their shapes the pads, the tips and the frame between the pads. The least force stands in no description and is the
site's. Anything else at the end of an arm (turning or jointed fingers, one finger, three) is not guessed: the reason is
said instead, and no skill grasps until a person fills `gripper` in.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.importer.kinematic_chain import KinematicChain
from dualbrain.robots.importer.kinematic_tree import MOVABLE_JOINT_KINDS, KinematicTree, TreeJoint
from dualbrain.robots.importer.required_limits import StatedLimit
from dualbrain.robots.model import Bound, Gripper

Array = NDArray[np.float64]

CLOSED_GAP_RANGE = (-0.005, 0.010)
"""Room [m] between the fingers' shapes at the shut end of their range; what stays farther apart is no closed hand."""
TOOL_TO_TIP_DISTANCE = 0.009
"""How far above the tips the tool frame lies [m]."""
TIP_ZONE_HEIGHT = 0.02
"""Height of the zone above the tips whose middle the tool frame takes across the fingers [m]."""
MIN_APPROACH_COSINE = 0.7
"""Least cosine between the approach and the way from the palm to the fingers."""
DIRECTION_TOLERANCE = 1e-3
"""Largest error of a direction that should be parallel or square."""


@dataclass(frozen=True, slots=True)
class DetectedGripper:
    """A gripper and its tool frame (4, 4) in the last chain frame: z along the approach, y along the fingers' line."""

    gripper: Gripper
    tool: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class _Finger:
    """A finger: its joint, its range [m], the line `way` (3,) it slides along, its corners (p, 3) at zero."""

    joint: TreeJoint
    direction: Array
    corners: Array
    lower: float
    upper: float

    def corners_at(self, q: float) -> Array:
        return self.corners + q * self.direction


class _NotDetectedError(Exception):
    """What keeps the hand from being told; never leaves this module."""


def detect_gripper(
    tree: KinematicTree, chain: KinematicChain, stated_limits: Mapping[str, StatedLimit], *, keep_tool: bool
) -> DetectedGripper | str:
    """The hand at the end of `chain`, or why none could be told; with `keep_tool` the chain's own tool frame stays.

    `said` may state "grip_force" and "grip_force_min" [N].
    """
    try:
        return _detect(tree, chain, stated_limits, chain.tool if keep_tool else None)
    except _NotDetectedError as why:
        return str(why)


def _detect(
    tree: KinematicTree, chain: KinematicChain, stated_limits: Mapping[str, StatedLimit], tool: Array | None
) -> DetectedGripper:
    one, other = _find_fingers(tree, chain)
    stroke = one.upper - one.lower
    if (
        abs(stroke - (other.upper - other.lower)) > 1e-4
        or float(one.direction @ other.direction) > DIRECTION_TOLERANCE - 1.0
    ):
        raise _NotDetectedError(f"{one.joint.name} and {other.joint.name} do not slide apart alike on one line")
    apart: Array = one.corners.mean(axis=0) - other.corners.mean(axis=0)
    outward = float(apart @ one.direction) > 0.0
    line = one.direction if outward else -one.direction  # from the other finger to this one
    shut = [finger.corners_at(finger.lower if outward else finger.upper) for finger in (one, other)]
    near, far = float((shut[0] @ line).min()), float((shut[1] @ line).max())
    if not CLOSED_GAP_RANGE[0] <= near - far <= CLOSED_GAP_RANGE[1]:
        raise _NotDetectedError(f"fingers are {1e3 * (near - far):.0f} mm apart at the shut end of {one.joint.name}")
    points = np.vstack(shut)
    approach = _approach_axis(tree, chain, one.joint, points, line)
    frame, below, thickness = _measure(points, line, approach, 0.5 * (near + far), tool)
    opening = Bound(round(stroke, 6), "m", f"{one.joint.source_location}: {one.joint.name} limit upper − lower")
    greatest, least = _grip_force_bounds((one, other), stated_limits)
    gripper = Gripper(
        opening=opening,
        force=greatest,
        force_min=least,
        pad_below_tool=round(below, 4),
        finger_thickness=round(thickness, 4),
    )
    return DetectedGripper(gripper, frame)


def _find_fingers(tree: KinematicTree, chain: KinematicChain) -> tuple[_Finger, _Finger]:
    """The two fingers, counted so that they slide against each other."""
    n, driven = len(chain.joints), {joint.name for joint in chain.joints}
    riders = {rider.link: rider for rider in chain.segments}
    hanging = [joint for joint in tree.joints if joint.kind in MOVABLE_JOINT_KINDS and joint.name not in driven]
    movers = [joint for joint in hanging if riders[joint.child].is_swept and riders[joint.child].frame == n]
    if not movers:
        raise _NotDetectedError("no fingers that move")
    if any(riders[joint.parent].is_swept for joint in movers):
        raise _NotDetectedError("fingers with joints of their own")
    if len(movers) != 2 or any(joint.kind != "prismatic" for joint in movers):
        kinds = ", ".join(sorted({joint.kind for joint in movers}))
        raise _NotDetectedError(f"{len(movers)} joints of fingers, {kinds}; not two that slide")
    one, other = (_make_finger(tree, riders[joint.parent].poses[0] @ joint.pose, joint, movers) for joint in movers)
    if one.direction @ other.direction > 0.0:  # the same axis, counted the other way
        other = replace(other, direction=-other.direction, lower=-other.upper, upper=-other.lower)
    return one, other


def _make_finger(tree: KinematicTree, base: Array, joint: TreeJoint, finger_joints: list[TreeJoint]) -> _Finger:
    """The finger on `joint`, whose frame at zero is `base` (4, 4); one that follows has the leader's range."""
    lower, upper = joint.lower, joint.upper
    leader = next((one for one in finger_joints if joint.mimic and one.name == joint.mimic.leader), None)
    if leader is not None and joint.mimic is not None and leader.lower is not None and leader.upper is not None:
        lower, upper = sorted(joint.mimic.multiplier * q + joint.mimic.offset for q in (leader.lower, leader.upper))
    if lower is None or upper is None:
        raise _NotDetectedError(f"{joint.name} has no range")
    corners = _collect_corners(tree, joint.child, base)
    if corners is None:
        raise _NotDetectedError(f"{joint.name} moves nothing that has a shape")
    return _Finger(joint=joint, direction=base[:3, :3] @ joint.axis, corners=corners, lower=lower, upper=upper)


def _collect_corners(tree: KinematicTree, link: str, pose: Array) -> Array | None:
    """Corners (p, 3) of the shapes of `link` and of what is fixed to it, `pose` (4, 4) being the link's."""
    found = [piece.load_mesh().vertices @ pose[:3, :3].T + pose[:3, 3] for piece in tree.links[link].shapes]
    for joint in tree.joints:
        if joint.parent == link and joint.kind == "fixed":
            below = _collect_corners(tree, joint.child, pose @ joint.pose)
            found += [] if below is None else [below]
    return np.vstack(found) if found else None


def _approach_axis(tree: KinematicTree, chain: KinematicChain, joint: TreeJoint, points: Array, line: Array) -> Array:
    """The axis (3,) of the fingers' parent link that is square to their line and leads from the parent to them."""
    pose = next(rider for rider in chain.segments if rider.link == joint.parent).poses[0]
    palm = _collect_corners(tree, joint.parent, pose)
    way = points.mean(axis=0) - (pose[:3, 3] if palm is None else palm.mean(axis=0))
    way = way - line * (way @ line)
    axes = np.vstack([pose[:3, :3].T, -pose[:3, :3].T])
    square = axes[np.abs(axes @ line) < DIRECTION_TOLERANCE]
    if not len(square) or float(np.max(square @ way)) < MIN_APPROACH_COSINE * float(np.linalg.norm(way)):
        raise _NotDetectedError(f"no axis of {joint.parent} square to the fingers' line leads to their tips")
    return square[int(np.argmax(square @ way))]


def _measure(
    points: Array, line: Array, approach: Array, middle: float, tool: Array | None
) -> tuple[Array, float, float]:
    """Tool frame (4, 4), how far the pads reach beyond it [m], and how thick a shut finger is [m]."""
    side = np.cross(line, approach)
    tip = float((points @ approach).max())
    zone = points[points @ approach > tip - TIP_ZONE_HEIGHT]
    thickness = float(np.max(np.abs(points @ line - middle)))
    if tool is not None:
        if abs(tool[:3, 1] @ line) < 1.0 - DIRECTION_TOLERANCE or tool[:3, 2] @ approach < 1.0 - DIRECTION_TOLERANCE:
            raise _NotDetectedError("the tool frame's z is not the approach, or its y not the fingers' line")
        return tool, tip - float(tool[:3, 3] @ approach), thickness
    across = 0.5 * float((zone @ side).min() + (zone @ side).max())
    frame = np.eye(4)
    frame[:3, :3] = np.column_stack([side, line, approach])
    frame[:3, 3] = across * side + middle * line + (tip - TOOL_TO_TIP_DISTANCE) * approach
    return frame, TOOL_TO_TIP_DISTANCE, thickness


def _grip_force_bounds(
    fingers: tuple[_Finger, _Finger], stated_limits: Mapping[str, StatedLimit]
) -> tuple[Bound, Bound]:
    """Greatest and least grip force [N]; the narrowest word holds for the greatest."""
    stated = [
        StatedLimit(finger.joint.effort, f"{finger.joint.source_location}: {finger.joint.name} limit effort")
        for finger in fingers
        if finger.joint.effort
    ]
    stated += [stated_limits["grip_force"]] if "grip_force" in stated_limits else []
    if not stated or "grip_force_min" not in stated_limits:
        raise _NotDetectedError("two fingers that slide, their force not stated: --grip LEAST,GREATEST in N")
    greatest, least = min(stated, key=lambda one: one.value), stated_limits["grip_force_min"]
    if not least.value <= greatest.value:
        raise _NotDetectedError(f"least grip force {least.value:g} N above the greatest, {greatest.value:g} N")
    return Bound(greatest.value, "N", greatest.provenance), Bound(least.value, "N", least.provenance)
