"""One serial chain out of a tree: which joints move, and where every rigid part of the robot rides.

Chain frame i is the child link's frame of joint i, turned by A_i so that the joint's axis is z; frame 0 is the base.
T_i = A_(i-1)⁻¹ (fixed joints between) (joint's own pose) A_i, followed by the motion about or along z.

Joints off the chain: those that hang on its last frame (fingers) are swept over their ranges; all others stand where
`lock` puts them, else at the value nearest to zero, and this is said.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError
from dualbrain.robots.importer.kinematic_tree import MOVABLE_JOINT_KINDS, KinematicTree, TreeJoint

Array = NDArray[np.float64]

MAX_FINGER_JOINTS = 3
"""A branch with at most this many joints in a row is a gripper or a sensor, not an arm."""
FingerJoints = tuple[tuple[TreeJoint, Array | None], ...]
"""Joints between the chain and a part beyond it, with their step (4, 4), or None where they are swept."""
SWEEP_SAMPLES = {0: 1, 1: 7, 2: 5, 3: 4}
"""Values of each joint that a part is swept over, by the number of joints between it and the chain."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RigidSegment:
    """A link of the file that rides on chain frame `frame` (0 = base) at each of `poses` (k, 4, 4) in that frame.

    `beyond` says that it lies past the last joint's own link, `swept` that joints of its own move it.
    """

    link: str
    frame: int
    poses: Array
    is_past_last_joint: bool = False
    is_swept: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class KinematicChain:
    """The chosen chain: `joints` from base to tip, `offsets` (n, 4, 4) = T_i, `riders`, where the `tool` is (4, 4).

    `locked` are the joints off the chain that stand still, with their values.
    """

    base: str
    tip: str
    joints: tuple[TreeJoint, ...]
    offsets: Array
    segments: tuple[RigidSegment, ...]
    tool: Array
    locked: dict[str, float]


def find_chain(
    tree: KinematicTree, *, base: str = "", tip: str = "", tool: str = "", lock: Mapping[str, float] | None = None
) -> KinematicChain:
    """The chain from `base` (default: the root) to `tip` (default: the one arm), with the tool frame on link `tool`.

    Raises:
        UnknownName: a link or joint is not there.
        InvalidSetup: there are several arms and none is named; the chain has no joint, or one that one control cannot
            drive; the tool does not ride on the last joint.
    """
    lock = dict(lock or {})
    for name in lock:
        tree.joint(name)
    base = tree.link(base).name if base else tree.root
    tip = tree.link(tip or tool).name if (tip or tool) else _only_end_effector(tree, base)
    joints = _joint_path(tree, base, tip)
    moving = tuple(joint for joint in joints if joint.kind != "fixed" and joint.name not in lock)
    _check_drivable(moving, base, tip, tree)
    offsets, aligns = _offsets(joints, moving, lock)
    riders, locked = _segments(tree, base, moving, aligns, lock)
    end = tool or tip
    place = next(rider for rider in riders if rider.link == end)
    if place.frame != len(moving) or len(place.poses) != 1:
        raise ConfigurationError("tool", got=end, allowed=f"a link fixed to the last joint's, {moving[-1].child!r}")
    return KinematicChain(
        base=base, tip=tip, joints=moving, offsets=offsets, segments=riders, tool=place.poses[0], locked=locked
    )


def find_end_effectors(tree: KinematicTree, base: str) -> list[str]:
    """Links at which the arms below `base` end: before the fingers, where all branches are short."""
    return sorted({tip for tip, count in _branch_tips(tree, _child_joints(tree), base) if count > 0})


def _only_end_effector(tree: KinematicTree, base: str) -> str:
    ends = find_end_effectors(tree, base)
    if len(ends) != 1:
        raise ConfigurationError(
            f"end effectors of {tree.source}",
            got=", ".join(ends) or "none",
            allowed="one, or the one that is named",
            fix=" or ".join(f"--chain {base}..{tip}" for tip in ends[:6]) or "Name one: --chain BASE..TIP.",
        )
    return ends[0]


def _child_joints(tree: KinematicTree) -> dict[str, list[TreeJoint]]:
    below: dict[str, list[TreeJoint]] = {name: [] for name in tree.links}
    for joint in tree.joints:
        below[joint.parent].append(joint)
    return below


def _depth(below: Mapping[str, list[TreeJoint]], joint: TreeJoint) -> int:
    """Most driven joints in a row from `joint` on."""
    own = int(joint.kind in MOVABLE_JOINT_KINDS and joint.mimic is None)
    return own + max((_depth(below, further) for further in below[joint.child]), default=0)


def _branch_tips(tree: KinematicTree, below: Mapping[str, list[TreeJoint]], base: str) -> list[tuple[str, int]]:
    """(last link before the fingers, joints from base to it) of every branch below `base`."""
    ends: list[tuple[str, int]] = []

    def follow(link: str, count: int) -> None:
        hanging = [joint for joint in _next_moving_joints(below, link) if joint.kind in MOVABLE_JOINT_KINDS]
        long = [joint for joint in hanging if _depth(below, joint) > MAX_FINGER_JOINTS]
        onward = hanging if len(hanging) == 1 and hanging[0].mimic is None else long
        if not onward:
            ends.append((link, count))
        for joint in onward:
            follow(joint.child, count + 1)

    follow(base, 0)
    return ends


def _next_moving_joints(below: Mapping[str, list[TreeJoint]], link: str) -> list[TreeJoint]:
    """Joints that move and hang on `link` or on what is fixed to it."""
    found: list[TreeJoint] = []
    for joint in below[link]:
        found += _next_moving_joints(below, joint.child) if joint.kind == "fixed" else [joint]
    return found


def _joint_path(tree: KinematicTree, base: str, tip: str) -> list[TreeJoint]:
    above = {joint.child: joint for joint in tree.joints}
    path: list[TreeJoint] = []
    link = tip
    while link != base:
        if link not in above:
            raise ConfigurationError("chain", got=f"{base}..{tip}", allowed="a tip below its base")
        path.append(above[link])
        link = above[link].parent
    return path[::-1]


def _check_drivable(moving: tuple[TreeJoint, ...], base: str, tip: str, tree: KinematicTree) -> None:
    if not moving:
        raise ConfigurationError(
            "chain",
            got=f"{base}..{tip} without a moving joint",
            allowed="at least one",
            fix=f"Ends of {tree.source}: {', '.join(find_end_effectors(tree, tree.root))}.",
        )
    for joint in moving:
        if joint.kind not in MOVABLE_JOINT_KINDS:
            raise ConfigurationError(
                f"joint {joint.name!r} of the chain ({joint.source_location})",
                got=joint.kind,
                allowed=", ".join(MOVABLE_JOINT_KINDS),
                fix=f"Begin the chain behind it (--chain {joint.child}..{tip}); for a robot on wheels see --base.",
            )
        if joint.mimic is not None:
            raise ConfigurationError(
                f"joint {joint.name!r} of the chain ({joint.source_location})",
                got=f"follows {joint.mimic.leader!r}",
                allowed="joints that are driven one by one",
                fix=f"Hold it still: --lock {joint.name}=VALUE.",
            )


def _offsets(joints: list[TreeJoint], moving: tuple[TreeJoint, ...], lock: Mapping[str, float]) -> tuple[Array, Array]:
    """T_i (n, 4, 4) and A_i (n, 4, 4)."""
    offsets: list[Array] = []
    aligns: list[Array] = []
    here = np.eye(4)  # pose of the current link in the last chain frame
    for joint in joints:
        if joint in moving:
            align = _z_to_axis_rotation(joint.axis)
            offsets.append(here @ joint.pose @ align)
            aligns.append(align)
            here = align.T
        else:
            here = here @ joint.child_pose(lock.get(joint.name, 0.0))
    return np.array(offsets), np.array(aligns)


def _z_to_axis_rotation(axis: Array) -> Array:
    """The shortest turn (4, 4) that brings z to `axis`."""
    x, y, z = axis
    pose = np.eye(4)
    if z < -1.0 + 1e-12:
        pose[:3, :3] = np.diag([1.0, -1.0, -1.0])
    else:
        w = 1.0 / (1.0 + z)
        pose[:3, :3] = [[1.0 - x * x * w, -x * y * w, x], [-x * y * w, 1.0 - y * y * w, y], [-x, -y, z]]
    return pose


def link_poses_at_rest(
    tree: KinematicTree, base: str, lock: Mapping[str, float]
) -> tuple[dict[str, Array], dict[str, float]]:
    """Pose (4, 4) of every link in the frame of `base` with all joints still, and where they stand."""
    for name in lock:
        tree.joint(name)
    still = {joint.name: _rest_value(joint, lock) or 0.0 for joint in tree.joints if joint.kind != "fixed"}
    riders, _ = _segments(tree, base, (), np.empty((0, 4, 4)), still)
    return {rider.link: rider.poses[0] for rider in riders}, still


def _segments(
    tree: KinematicTree, base: str, moving: tuple[TreeJoint, ...], aligns: Array, lock: Mapping[str, float]
) -> tuple[tuple[RigidSegment, ...], dict[str, float]]:
    """Every link of the tree with the chain frame it rides on; the walk goes both up and down from `base`."""
    touching: dict[str, list[TreeJoint]] = {name: [] for name in tree.links}
    for joint in tree.joints:
        touching[joint.parent].append(joint)
        touching[joint.child].append(joint)
    number = {joint.name: i for i, joint in enumerate(moving, start=1)}
    values = {
        joint.name: q for joint in tree.joints if joint.kind != "fixed" and (q := _rest_value(joint, lock)) is not None
    }
    riders: list[RigidSegment] = []
    locked: dict[str, float] = {}
    seen: set[str] = set()

    def walk(link: str, frame: int, pose: Array, fingers: FingerJoints, beyond: bool) -> None:
        """`pose` is the link's, if no finger joint lies between; else that of the last link before `fingers`."""
        seen.add(link)
        riders.append(
            RigidSegment(
                link=link,
                frame=frame,
                poses=_swept_poses(pose, fingers),
                is_past_last_joint=beyond,
                is_swept=bool(fingers),
            )
        )
        for joint in touching[link]:
            down = joint.parent == link
            other = joint.child if down else joint.parent
            if other in seen:
                continue
            if joint.name in number and down:
                at = number[joint.name]
                walk(other, at, aligns[at - 1].T, (), False)
                continue
            outer = beyond or frame == len(moving)
            if down and frame == len(moving) and _is_finger(joint, lock, fingers):
                walk(other, frame, pose, (*fingers, (joint, None)), outer)
                continue
            if joint.kind != "fixed":
                locked[joint.name] = values.get(joint.name, 0.0)
            step = joint.child_pose(values.get(joint.name, 0.0))
            if fingers:
                walk(other, frame, pose, (*fingers, (joint, step)), outer)
            else:
                walk(other, frame, pose @ (step if down else np.linalg.inv(step)), (), outer)

    walk(base, 0, np.eye(4), (), False)
    return tuple(riders), locked


def _is_finger(joint: TreeJoint, lock: Mapping[str, float], before: FingerJoints) -> bool:
    swept = sum(step is None for _, step in before)
    return joint.kind in MOVABLE_JOINT_KINDS and joint.name not in lock and swept < MAX_FINGER_JOINTS


def _swept_poses(pose: Array, fingers: FingerJoints) -> Array:
    """Poses (k, 4, 4) of a link over the ranges of the finger joints before it."""
    free = [joint for joint, step in fingers if step is None]
    grids = [_sweep_values(joint, SWEEP_SAMPLES[len(free)]) for joint in free]
    poses: list[Array] = []
    for values in product(*grids):
        at = {joint.name: float(q) for joint, q in zip(free, values, strict=True)}
        moved = pose
        for joint, step in fingers:
            moved = moved @ (joint.child_pose(at[joint.name]) if step is None else step)
        poses.append(moved)
    return np.array(poses)


def _sweep_values(joint: TreeJoint, count: int) -> Array:
    if joint.kind == "continuous" or joint.lower is None or joint.upper is None:
        return np.linspace(-np.pi, np.pi, 3 * count)
    return np.linspace(joint.lower, joint.upper, count)


def _rest_value(joint: TreeJoint, lock: Mapping[str, float]) -> float | None:
    """Where a joint off the chain stands."""
    if joint.name in lock:
        return float(lock[joint.name])
    if joint.kind not in MOVABLE_JOINT_KINDS:
        return None
    return float(
        np.clip(
            0.0, joint.lower if joint.lower is not None else -np.inf, joint.upper if joint.upper is not None else np.inf
        )
    )
