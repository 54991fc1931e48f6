"""Kinematic tree of a robot description: links with shapes, and joints with limits and the line of the file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.assets.meshes import Mesh

Array = NDArray[np.float64]
JointKind = Literal["fixed", "revolute", "continuous", "prismatic", "planar", "floating"]

MOVABLE_JOINT_KINDS: tuple[JointKind, ...] = ("revolute", "continuous", "prismatic")
"""Kinds of joint that a single control can drive."""


@dataclass(frozen=True, slots=True)
class LinkShape:
    """One shape of a link: a `label` for messages, and a function that loads its mesh, in metres in the link frame."""

    label: str
    load_mesh: Callable[[], Mesh]


@dataclass(frozen=True, slots=True)
class TreeLink:
    """A rigid link with its collision shapes, or its visual shapes if it has no others (`uses_visual_shapes`)."""

    name: str
    shapes: tuple[LinkShape, ...] = ()
    uses_visual_shapes: bool = False


@dataclass(frozen=True, slots=True)
class Mimic:
    """The rule of a joint that follows another joint, its leader: q = multiplier × q_leader + offset."""

    leader: str
    multiplier: float
    offset: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TreeJoint:
    """A joint: `pose` (4, 4) of its frame in the parent link, unit `axis` (3,) in that frame.

    A limit is None if the file does not state it; limits are in rad, rad/s, rad/s² and rad/s³ (prismatic joints in m),
    the effort in N m or N. `source_location` is file and line, for the provenance.
    """

    name: str
    kind: JointKind
    parent: str
    child: str
    pose: Array
    axis: Array
    source_location: str
    lower: float | None = None
    upper: float | None = None
    velocity: float | None = None
    acceleration: float | None = None
    jerk: float | None = None
    mimic: Mimic | None = None
    effort: float | None = None

    def child_pose(self, q: float) -> Array:
        """Pose (4, 4) of the child link in the parent link at joint value q [rad or m]."""
        moved = np.eye(4)
        if self.kind in ("revolute", "continuous"):
            moved[:3, :3] = axis_rotation(self.axis, q)
        elif self.kind == "prismatic":
            moved[:3, 3] = q * self.axis
        return self.pose @ moved


@dataclass(frozen=True, slots=True, kw_only=True)
class KinematicTree:
    """All links and joints of a description. `notes` are remarks of the reader for the user."""

    name: str
    source: str
    licence: str
    links: dict[str, TreeLink]
    joints: tuple[TreeJoint, ...]
    notes: tuple[str, ...] = ()

    def link(self, name: str) -> TreeLink:
        """The link called `name`; raises `UnknownNameError`."""
        if name not in self.links:
            raise UnknownNameError("link", name, tuple(self.links), owner=self.source)
        return self.links[name]

    def joint(self, name: str) -> TreeJoint:
        """The joint called `name`; raises `UnknownNameError`."""
        for joint in self.joints:
            if joint.name == name:
                return joint
        raise UnknownNameError("joint", name, tuple(joint.name for joint in self.joints), owner=self.source)

    @property
    def root(self) -> str:
        """The link that is not the child of any joint."""
        children = {joint.child for joint in self.joints}
        return next(name for name in self.links if name not in children)

    def validate(self) -> KinematicTree:
        """This tree.

        Raises:
            ConfigurationError: A joint names a link that does not exist, a link has two parents, or there is not
                exactly one root.
        """
        parent_joints: dict[str, str] = {}
        for joint in self.joints:
            for link in (joint.parent, joint.child):
                if link not in self.links:
                    raise ConfigurationError(
                        f"link of {joint.name!r} ({joint.source_location})", got=link, allowed="a link of the file"
                    )
            if joint.child in parent_joints:
                raise ConfigurationError.stating(
                    f"Link {joint.child!r} ({joint.source_location}) is the child of the joints "
                    f"{parent_joints[joint.child]!r} and {joint.name!r}.",
                    fix="Give each link one parent.",
                )
            parent_joints[joint.child] = joint.name
        roots = [name for name in self.links if name not in parent_joints]
        if len(roots) != 1 or len(self.joints) != len(self.links) - 1:
            raise ConfigurationError(f"links of {self.source}", got=f"roots {roots}", allowed="one tree with one root")
        return self


def axis_rotation(axis: Array, angle: float) -> Array:
    """Rotation (3, 3) by `angle` [rad] about the unit vector `axis`: R = I + sin θ K + (1 − cos θ) K² (Rodrigues)."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * (K @ K)
