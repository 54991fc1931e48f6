"""Extraction of one serial chain from a kinematic tree: its joints, and the chain frame of every link of the tree.

Chain frame i is the frame of the child link of joint i, rotated by A_i so that the axis of the joint is z; frame 0 is
the base. T_i = A_(i-1)⁻¹ (fixed joints in between) (pose of the joint) A_i, followed by the motion about or along z.

Joints outside the chain: those behind the last frame (fingers) are swept over their ranges. All others are fixed at
their value in `lock`, at that which a fixed leader gives them by their mimic rule, or at the value nearest to zero, and
are reported in `KinematicChain.locked`. A joint that follows a joint of the chain is refused unless it is in `lock`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from math import ceil

import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError
from dualbrain.robots.collision_model.swept_volume import arc_enlargement
from dualbrain.robots.importer.kinematic_tree import MOVABLE_JOINT_KINDS, KinematicTree, TreeJoint

Array = NDArray[np.float64]

MAX_FINGER_JOINTS = 3
"""A branch with at most this many joints in a row is a gripper or a sensor, not an arm."""
FingerJoints = tuple[tuple[TreeJoint, Array | None], ...]
"""Joints between the chain and a link behind it, with their transform (4, 4), or None if they are swept."""
SWEEP_CELLS = {1: 6, 2: 4, 3: 3}
"""Least number of cells of the range of a swept joint, by the number of swept joints between a link and the chain."""
MAX_SWEEP_ANGLE = {1: 0.3, 2: 0.5, 3: 0.8}
"""Largest cell of a turning swept joint [rad], by the same number; a large one enlarges the swept volume."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RigidSegment:
    """A link of the tree, attached to chain frame `frame` (0 = base) at each of `poses` (k, 4, 4) in that frame.

    `is_past_last_joint` is True for links behind the child link of the last joint, `is_swept` for links that finger
    joints move, which have one pose for each sampled value. `sweep` (cells, corners, 4, 4) are the transforms for
    `swept_mesh`, one cell with one corner for a link that is not swept.
    """

    link: str
    frame: int
    poses: Array
    sweep: Array
    is_past_last_joint: bool = False
    is_swept: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class KinematicChain:
    """A serial chain: `joints` from base to tip, `offsets` (n, 4, 4) = T_i, all links as `segments`.

    `tool` (4, 4) is the tool frame in the last chain frame. `locked` are the joints outside the chain that are assumed
    to be fixed, with their values [rad or m].
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
    """The chain from `base` (default: the root) to `tip` (default: the only arm), with the tool frame on link `tool`.

    Raises:
        UnknownNameError: A link or joint does not exist.
        ConfigurationError: There are several arms and no tip is given, the chain has no moving joint or a joint that a
            single control cannot drive, a joint outside the chain follows one of the chain, or the tool link is not
            fixed to the link of the last joint.
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
    segments, locked = _segments(tree, base, moving, aligns, lock)
    tool_link = tool or tip
    tool_segment = next(segment for segment in segments if segment.link == tool_link)
    if tool_segment.frame != len(moving) or len(tool_segment.poses) != 1:
        allowed = f"a link fixed to the last joint's link, {moving[-1].child!r}"
        raise ConfigurationError("tool", got=tool_link, allowed=allowed)
    return KinematicChain(
        base=base,
        tip=tip,
        joints=moving,
        offsets=offsets,
        segments=segments,
        tool=tool_segment.poses[0],
        locked=locked,
    )


def find_end_effectors(tree: KinematicTree, base: str) -> list[str]:
    """The last links of the arms below `base`; the fingers of an arm, which are short branches, do not count."""
    return sorted({tip for tip, n_joints in _branch_tips(tree, _child_joints(tree), base) if n_joints > 0})


def _only_end_effector(tree: KinematicTree, base: str) -> str:
    ends = find_end_effectors(tree, base)
    if len(ends) != 1:
        chains = " or ".join(f"--chain {base}..{tip}" for tip in ends[:6])
        raise ConfigurationError.stating(
            f"{tree.source} does not have one end effector, but {', '.join(ends) or 'none'}.",
            fix=f"Choose the chain: {chains or '--chain BASE..TIP'}.",
        )
    return ends[0]


def _child_joints(tree: KinematicTree) -> dict[str, list[TreeJoint]]:
    children: dict[str, list[TreeJoint]] = {name: [] for name in tree.links}
    for joint in tree.joints:
        children[joint.parent].append(joint)
    return children


def _depth(children: Mapping[str, list[TreeJoint]], joint: TreeJoint) -> int:
    """Maximum number of driven joints in a row, from `joint` on."""
    driven = int(joint.kind in MOVABLE_JOINT_KINDS and joint.mimic is None)
    return driven + max((_depth(children, child) for child in children[joint.child]), default=0)


def _branch_tips(tree: KinematicTree, children: Mapping[str, list[TreeJoint]], base: str) -> list[tuple[str, int]]:
    """(last link before the fingers, number of joints from base to it) of every branch below `base`."""
    tips: list[tuple[str, int]] = []

    def follow(link: str, n_joints: int) -> None:
        joints = [joint for joint in _next_moving_joints(children, link) if joint.kind in MOVABLE_JOINT_KINDS]
        long_branches = [joint for joint in joints if _depth(children, joint) > MAX_FINGER_JOINTS]
        branches = joints if len(joints) == 1 and joints[0].mimic is None else long_branches
        if not branches:
            tips.append((link, n_joints))
        for joint in branches:
            follow(joint.child, n_joints + 1)

    follow(base, 0)
    return tips


def _next_moving_joints(children: Mapping[str, list[TreeJoint]], link: str) -> list[TreeJoint]:
    """Moving joints whose parent is `link` or a link fixed to it."""
    found: list[TreeJoint] = []
    for joint in children[link]:
        found += _next_moving_joints(children, joint.child) if joint.kind == "fixed" else [joint]
    return found


def _joint_path(tree: KinematicTree, base: str, tip: str) -> list[TreeJoint]:
    parent_joints = {joint.child: joint for joint in tree.joints}
    path: list[TreeJoint] = []
    link = tip
    while link != base:
        if link not in parent_joints:
            raise ConfigurationError("chain", got=f"{base}..{tip}", allowed="a tip below its base")
        path.append(parent_joints[link])
        link = parent_joints[link].parent
    return path[::-1]


def _check_drivable(moving: tuple[TreeJoint, ...], base: str, tip: str, tree: KinematicTree) -> None:
    if not moving:
        raise ConfigurationError.stating(
            f"The chain {base}..{tip} has no moving joint.",
            fix=f"Choose another tip; end effectors of {tree.source}: "
            f"{', '.join(find_end_effectors(tree, tree.root)) or 'none'}.",
        )
    for joint in moving:
        if joint.kind not in MOVABLE_JOINT_KINDS:
            raise ConfigurationError(
                f"joint {joint.name!r} of the chain ({joint.source_location})",
                got=joint.kind,
                allowed=", ".join(MOVABLE_JOINT_KINDS),
                fix=f"Start the chain behind it (--chain {joint.child}..{tip}); for a robot on wheels see --base.",
            )
        if joint.mimic is not None:
            raise ConfigurationError.stating(
                f"Joint {joint.name!r} of the chain ({joint.source_location}) follows {joint.mimic.leader!r} and "
                "cannot be driven alone.",
                fix=f"Lock it: --lock {joint.name}=VALUE.",
            )


def _offsets(joints: list[TreeJoint], moving: tuple[TreeJoint, ...], lock: Mapping[str, float]) -> tuple[Array, Array]:
    """T_i (n, 4, 4) and A_i (n, 4, 4)."""
    offsets: list[Array] = []
    aligns: list[Array] = []
    pose = np.eye(4)  # pose of the current link in the last chain frame
    for joint in joints:
        if joint in moving:
            align = _z_to_axis_rotation(joint.axis)
            offsets.append(pose @ joint.pose @ align)
            aligns.append(align)
            pose = align.T
        else:
            pose = pose @ joint.child_pose(lock.get(joint.name, 0.0))
    return np.array(offsets), np.array(aligns)


def _z_to_axis_rotation(axis: Array) -> Array:
    """The smallest rotation (4, 4) that turns z to the unit vector `axis` (3,)."""
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
    """Pose (4, 4) of every link in the frame of `base` with all joints fixed, and the values of the joints.

    A joint has its value in `lock`, that which its leader gives it, or the value nearest to zero.
    """
    for name in lock:
        tree.joint(name)
    values = {joint.name: 0.0 for joint in tree.joints if joint.kind != "fixed"} | _rest_values(tree, (), lock)
    segments, _ = _segments(tree, base, (), np.empty((0, 4, 4)), values)
    return {segment.link: segment.poses[0] for segment in segments}, values


def _segments(
    tree: KinematicTree, base: str, moving: tuple[TreeJoint, ...], aligns: Array, lock: Mapping[str, float]
) -> tuple[tuple[RigidSegment, ...], dict[str, float]]:
    """Every link of the tree as a segment, and the locked joints; the walk goes up and down the tree from `base`."""
    joints_of: dict[str, list[TreeJoint]] = {name: [] for name in tree.links}
    for joint in tree.joints:
        joints_of[joint.parent].append(joint)
        joints_of[joint.child].append(joint)
    frames = {joint.name: i for i, joint in enumerate(moving, start=1)}
    values = _rest_values(tree, moving, lock)
    segments: list[RigidSegment] = []
    locked: dict[str, float] = {}
    seen: set[str] = set()

    def walk(link: str, frame: int, pose: Array, fingers: FingerJoints, past_last_joint: bool) -> None:
        """Visit `link`; `pose` is that of the link, or, with finger joints, that of the last link before them."""
        seen.add(link)
        segments.append(
            RigidSegment(
                link=link,
                frame=frame,
                poses=_swept_poses(pose, fingers),
                sweep=_sweep_cells(pose, fingers),
                is_past_last_joint=past_last_joint,
                is_swept=bool(fingers),
            )
        )
        for joint in joints_of[link]:
            down = joint.parent == link
            other = joint.child if down else joint.parent
            if other in seen:
                continue
            if joint.name in frames and down:
                child_frame = frames[joint.name]
                walk(other, child_frame, aligns[child_frame - 1].T, (), False)
                continue
            past = past_last_joint or frame == len(moving)
            if down and frame == len(moving) and _is_finger(joint, lock, fingers):
                walk(other, frame, pose, (*fingers, (joint, None)), past)
                continue
            if joint.kind != "fixed":
                if joint.name not in lock:
                    _refuse_follower(joint, frames)
                locked[joint.name] = values.get(joint.name, 0.0)
            step = joint.child_pose(values.get(joint.name, 0.0))
            if fingers:
                walk(other, frame, pose, (*fingers, (joint, step)), past)
            else:
                walk(other, frame, pose @ (step if down else np.linalg.inv(step)), (), past)

    walk(base, 0, np.eye(4), (), False)
    return tuple(segments), locked


def _is_finger(joint: TreeJoint, lock: Mapping[str, float], previous: FingerJoints) -> bool:
    return joint.kind in MOVABLE_JOINT_KINDS and joint.name not in lock and _n_swept(previous) < MAX_FINGER_JOINTS


def _swept_poses(pose: Array, fingers: FingerJoints) -> Array:
    """Poses (k, 4, 4) of a link at all ends of the cells of the finger joints before it."""
    grids = [_sweep_values(joint, _n_swept(fingers)) for joint, step in fingers if step is None]
    joints = [joint for joint, step in fingers if step is None]
    return np.array(
        [
            _finger_pose(pose, fingers, [joint.child_pose(q) for joint, q in zip(joints, values, strict=True)])
            for values in product(*grids)
        ]
    )


def _sweep_cells(pose: Array, fingers: FingerJoints) -> Array:
    """Transforms (cells, corners, 4, 4) of a link for `swept_mesh`, over the ranges of the finger joints before it."""
    joints = [joint for joint, step in fingers if step is None]
    by_joint = [
        [_cell_corners(joint, low, high) for low, high in pairwise(_sweep_values(joint, len(joints)))]
        for joint in joints
    ]
    return np.array([[_finger_pose(pose, fingers, corner) for corner in product(*cell)] for cell in product(*by_joint)])


def _cell_corners(joint: TreeJoint, low: float, high: float) -> list[Array]:
    """Transforms (4, 4) of the child of `joint` whose hull contains it at every value from `low` to `high`."""
    ends = [joint.child_pose(low), joint.child_pose(high)]
    if joint.kind == "prismatic":
        return ends
    return [*ends, joint.child_pose(0.5 * (low + high)) @ arc_enlargement(joint.axis, high - low)]


def _finger_pose(pose: Array, fingers: FingerJoints, moved: Sequence[Array]) -> Array:
    """Transform (4, 4) of a link behind `fingers`, of which the swept ones have the transforms `moved`."""
    remaining = iter(moved)
    for _, step in fingers:
        pose = pose @ (next(remaining) if step is None else step)
    return pose


def _n_swept(fingers: FingerJoints) -> int:
    return sum(step is None for _, step in fingers)


def _sweep_values(joint: TreeJoint, n_swept: int) -> Array:
    """The ends of the cells of a joint, one of `n_swept` in a row [rad or m]; of a joint without range one turn.

    Raises `ConfigurationError` for a prismatic joint without a range.
    """
    lower, upper = joint.lower, joint.upper
    if joint.kind == "prismatic" and (lower is None or upper is None):
        raise ConfigurationError.stating(
            f"Joint {joint.name!r} ({joint.source_location}) behind the chain has no range, so it cannot be covered.",
            fix=f"State it in the description, or lock the joint: --lock {joint.name}=VALUE.",
        )
    if joint.kind == "continuous" or lower is None or upper is None:
        lower, upper = -np.pi, np.pi
    cells = SWEEP_CELLS[n_swept]
    if joint.kind != "prismatic":
        lower, upper = (lower, upper) if upper - lower < 2.0 * np.pi else (-np.pi, np.pi)
        cells = max(cells, ceil((upper - lower) / MAX_SWEEP_ANGLE[n_swept]))
    return np.linspace(lower, upper, cells + 1)


def _refuse_follower(joint: TreeJoint, chain_joints: Collection[str]) -> None:
    """Raise for a joint outside the chain that moves with a joint of the chain, so that its links are never fixed."""
    if joint.mimic is not None and joint.mimic.leader in chain_joints:
        raise ConfigurationError.stating(
            f"Joint {joint.name!r} ({joint.source_location}) outside the chain follows {joint.mimic.leader!r} of the "
            "chain, so the links behind it move, which the model cannot state.",
            fix=f"If these links may be modelled at rest, state where: --lock {joint.name}=VALUE.",
        )


def _rest_values(tree: KinematicTree, moving: tuple[TreeJoint, ...], lock: Mapping[str, float]) -> dict[str, float]:
    """The values of all joints of the tree outside the chain: those in `lock`, and those that follow without it."""
    joints = {joint.name: joint for joint in tree.joints}
    chain_joints = {joint.name for joint in moving}

    def rest_value(joint: TreeJoint, followers: frozenset[str]) -> float:
        leader = None if joint.mimic is None else joints.get(joint.mimic.leader)
        if joint.name in lock:
            return float(lock[joint.name])
        if joint.mimic is None or leader is None or leader.name in chain_joints | followers:
            return _nearest_to_zero(joint)
        return joint.mimic.multiplier * rest_value(leader, followers | {joint.name}) + joint.mimic.offset

    return {
        joint.name: rest_value(joint, frozenset({joint.name}))
        for joint in tree.joints
        if joint.name in lock or joint.kind in MOVABLE_JOINT_KINDS
    }


def _nearest_to_zero(joint: TreeJoint) -> float:
    lower = -np.inf if joint.lower is None else joint.lower
    upper = np.inf if joint.upper is None else joint.upper
    return float(np.clip(0.0, lower, upper))
