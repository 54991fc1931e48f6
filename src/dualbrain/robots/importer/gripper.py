"""Detection of a parallel gripper at the end of a chain: two fingers that slide apart on one line.

The description gives the stroke (range of the joints), the maximum force (effort of the joints, or the limit of the
site), and by the shapes of the fingers the pads, the tips and the frame between the pads. The minimum force is not part
of a description and must be stated. Any other gripper (revolute or jointed fingers, one finger, three fingers) is not
guessed: detection returns the reason, and no skill grasps until a person edits `gripper` in body.json.
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
"""Allowed gap [m] between the shapes of the fingers at the closed end of their range."""
TOOL_TO_TIP_DISTANCE = 0.009
"""Distance [m] of the tool frame from the finger tips, against the approach direction."""
TIP_ZONE_HEIGHT = 0.02
"""Height [m] of the zone at the finger tips whose centre the tool frame takes in the direction across the fingers."""
MIN_APPROACH_COSINE = 0.7
"""Minimum cosine between the approach direction and the direction from the palm to the fingers."""
DIRECTION_TOLERANCE = 1e-3
"""Maximum error of the cosine between directions that must be parallel or perpendicular."""


@dataclass(frozen=True, slots=True)
class DetectedGripper:
    """A gripper and its tool frame (4, 4) in the last chain frame: z along the approach, y along the finger axis."""

    gripper: Gripper
    tool: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class _Finger:
    """A finger: its joint, its range [m], the `direction` (3,) of its motion, and its vertices (p, 3) at zero."""

    joint: TreeJoint
    direction: Array
    vertices: Array
    lower: float
    upper: float

    def vertices_at(self, q: float) -> Array:
        return self.vertices + q * self.direction


class _NotDetectedError(Exception):
    """The reason why no gripper was detected; never leaves this module."""


def detect_gripper(
    tree: KinematicTree, chain: KinematicChain, stated_limits: Mapping[str, StatedLimit], *, keep_tool: bool
) -> DetectedGripper | str:
    """The gripper at the end of `chain`, or the reason why none was detected.

    `stated_limits` may contain "grip_force" and "grip_force_min" [N]. With `keep_tool` the tool frame of the chain is
    used instead of one between the finger tips.
    """
    try:
        return _detect(tree, chain, stated_limits, chain.tool if keep_tool else None)
    except _NotDetectedError as reason:
        return str(reason)


def _detect(
    tree: KinematicTree, chain: KinematicChain, stated_limits: Mapping[str, StatedLimit], tool: Array | None
) -> DetectedGripper:
    one, other = _find_fingers(tree, chain)
    stroke = one.upper - one.lower
    if (
        abs(stroke - (other.upper - other.lower)) > 1e-4
        or float(one.direction @ other.direction) > DIRECTION_TOLERANCE - 1.0
    ):
        raise _NotDetectedError(f"{one.joint.name} and {other.joint.name} do not slide apart by the same stroke")
    offset: Array = one.vertices.mean(axis=0) - other.vertices.mean(axis=0)
    outward = float(offset @ one.direction) > 0.0
    axis = one.direction if outward else -one.direction  # from the other finger to this one
    closed = [finger.vertices_at(finger.lower if outward else finger.upper) for finger in (one, other)]
    inner_one, inner_other = float((closed[0] @ axis).min()), float((closed[1] @ axis).max())
    gap = inner_one - inner_other
    if not CLOSED_GAP_RANGE[0] <= gap <= CLOSED_GAP_RANGE[1]:
        raise _NotDetectedError(f"the fingers are {1e3 * gap:.0f} mm apart at the closed end of {one.joint.name}")
    vertices = np.vstack(closed)
    approach = _approach_axis(tree, chain, one.joint, vertices, axis)
    frame, pad_length, thickness = _measure(vertices, axis, approach, 0.5 * (inner_one + inner_other), tool)
    opening = Bound(round(stroke, 6), "m", f"{one.joint.source_location}: {one.joint.name} limit upper − lower")
    force, force_min = _grip_force_bounds((one, other), stated_limits)
    gripper = Gripper(
        opening=opening,
        force=force,
        force_min=force_min,
        pad_below_tool=round(pad_length, 4),
        finger_thickness=round(thickness, 4),
    )
    return DetectedGripper(gripper, frame)


def _find_fingers(tree: KinematicTree, chain: KinematicChain) -> tuple[_Finger, _Finger]:
    """The two fingers, with signs such that their directions are opposite."""
    n, chain_joints = len(chain.joints), {joint.name for joint in chain.joints}
    segments = {segment.link: segment for segment in chain.segments}
    others = [joint for joint in tree.joints if joint.kind in MOVABLE_JOINT_KINDS and joint.name not in chain_joints]
    finger_joints = [joint for joint in others if segments[joint.child].is_swept and segments[joint.child].frame == n]
    if not finger_joints:
        raise _NotDetectedError("no moving fingers")
    if any(segments[joint.parent].is_swept for joint in finger_joints):
        raise _NotDetectedError("jointed fingers")
    if len(finger_joints) != 2 or any(joint.kind != "prismatic" for joint in finger_joints):
        kinds = ", ".join(sorted({joint.kind for joint in finger_joints}))
        raise _NotDetectedError(f"{len(finger_joints)} finger joints ({kinds}) instead of two prismatic ones")
    one, other = (
        _make_finger(tree, segments[joint.parent].poses[0] @ joint.pose, joint, finger_joints)
        for joint in finger_joints
    )
    if one.direction @ other.direction > 0.0:  # the same axis with the opposite sign
        other = replace(other, direction=-other.direction, lower=-other.upper, upper=-other.lower)
    return one, other


def _make_finger(tree: KinematicTree, base: Array, joint: TreeJoint, finger_joints: list[TreeJoint]) -> _Finger:
    """The finger on `joint`, whose frame at zero is `base` (4, 4); a mimic joint has the range of its leader."""
    lower, upper = joint.lower, joint.upper
    leader = next((one for one in finger_joints if joint.mimic and one.name == joint.mimic.leader), None)
    if leader is not None and joint.mimic is not None and leader.lower is not None and leader.upper is not None:
        lower, upper = sorted(joint.mimic.multiplier * q + joint.mimic.offset for q in (leader.lower, leader.upper))
    if lower is None or upper is None:
        raise _NotDetectedError(f"{joint.name} has no range")
    vertices = _collect_vertices(tree, joint.child, base)
    if vertices is None:
        raise _NotDetectedError(f"the finger on {joint.name} has no shape")
    return _Finger(joint=joint, direction=base[:3, :3] @ joint.axis, vertices=vertices, lower=lower, upper=upper)


def _collect_vertices(tree: KinematicTree, link: str, pose: Array) -> Array | None:
    """Vertices (p, 3) of the shapes of `link` at `pose` (4, 4) and of the links fixed to it; None without shapes."""
    found = [shape.load_mesh().vertices @ pose[:3, :3].T + pose[:3, 3] for shape in tree.links[link].shapes]
    for joint in tree.joints:
        if joint.parent == link and joint.kind == "fixed":
            fixed = _collect_vertices(tree, joint.child, pose @ joint.pose)
            found += [] if fixed is None else [fixed]
    return np.vstack(found) if found else None


def _approach_axis(tree: KinematicTree, chain: KinematicChain, joint: TreeJoint, vertices: Array, axis: Array) -> Array:
    """The axis (3,) of the parent link of the fingers that is perpendicular to `axis` and points to the fingers."""
    pose = next(segment for segment in chain.segments if segment.link == joint.parent).poses[0]
    palm = _collect_vertices(tree, joint.parent, pose)
    to_fingers = vertices.mean(axis=0) - (pose[:3, 3] if palm is None else palm.mean(axis=0))
    to_fingers = to_fingers - axis * (to_fingers @ axis)
    axes = np.vstack([pose[:3, :3].T, -pose[:3, :3].T])
    perpendicular = axes[np.abs(axes @ axis) < DIRECTION_TOLERANCE]
    min_projection = MIN_APPROACH_COSINE * float(np.linalg.norm(to_fingers))
    if not len(perpendicular) or float(np.max(perpendicular @ to_fingers)) < min_projection:
        raise _NotDetectedError(f"no axis of {joint.parent} perpendicular to the finger axis points to the fingers")
    return perpendicular[int(np.argmax(perpendicular @ to_fingers))]


def _measure(
    vertices: Array, axis: Array, approach: Array, middle: float, tool: Array | None
) -> tuple[Array, float, float]:
    """Tool frame (4, 4), length of the pads beyond it [m], and thickness of a closed finger [m]."""
    side = np.cross(axis, approach)
    tip = float((vertices @ approach).max())
    zone = vertices[vertices @ approach > tip - TIP_ZONE_HEIGHT]
    thickness = float(np.max(np.abs(vertices @ axis - middle)))
    if tool is not None:
        if abs(tool[:3, 1] @ axis) < 1.0 - DIRECTION_TOLERANCE or tool[:3, 2] @ approach < 1.0 - DIRECTION_TOLERANCE:
            raise _NotDetectedError(
                "z of the tool frame is not the approach direction, or its y is not the finger axis"
            )
        return tool, tip - float(tool[:3, 3] @ approach), thickness
    across = 0.5 * float((zone @ side).min() + (zone @ side).max())
    frame = np.eye(4)
    frame[:3, :3] = np.column_stack([side, axis, approach])
    frame[:3, 3] = across * side + middle * axis + (tip - TOOL_TO_TIP_DISTANCE) * approach
    return frame, TOOL_TO_TIP_DISTANCE, thickness


def _grip_force_bounds(
    fingers: tuple[_Finger, _Finger], stated_limits: Mapping[str, StatedLimit]
) -> tuple[Bound, Bound]:
    """Maximum and minimum grip force [N]; the maximum is the smallest of the stated and described forces."""
    stated = [
        StatedLimit(finger.joint.effort, f"{finger.joint.source_location}: {finger.joint.name} limit effort")
        for finger in fingers
        if finger.joint.effort
    ]
    stated += [stated_limits["grip_force"]] if "grip_force" in stated_limits else []
    if not stated or "grip_force_min" not in stated_limits:
        raise _NotDetectedError("two prismatic fingers whose force is not stated: --grip LEAST,GREATEST in N")
    maximum, minimum = min(stated, key=lambda limit: limit.value), stated_limits["grip_force_min"]
    if not minimum.value <= maximum.value:
        raise _NotDetectedError(
            f"the minimum grip force, {minimum.value:g} N, is above the maximum, {maximum.value:g} N"
        )
    return Bound(maximum.value, "N", maximum.provenance), Bound(minimum.value, "N", minimum.provenance)
