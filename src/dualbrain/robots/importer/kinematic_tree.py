"""A robot as its description file has it: links with shapes, joints between them, and the line each was read from."""

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
"""Kinds of joint that one control drives."""


@dataclass(frozen=True, slots=True)
class LinkShape:
    """One shape of a link; `load` reads its mesh, in metres in the link's frame. `what` names it for people."""

    label: str
    load_mesh: Callable[[], Mesh]


@dataclass(frozen=True, slots=True)
class TreeLink:
    """A rigid part: the shapes it collides with. `drawn` says that these are the visual ones, for want of others."""

    name: str
    shapes: tuple[LinkShape, ...] = ()
    uses_visual_shapes: bool = False


@dataclass(frozen=True, slots=True)
class Mimic:
    """A joint that follows another: q = multiplier × q_of + offset."""

    leader: str
    multiplier: float
    offset: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TreeJoint:
    """A joint: `pose` (4, 4) of its frame in the parent link, `axis` (3,) in that frame.

    Limits are None where the file says nothing; `where` is the file and line, for provenance.
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
    """The whole description. `notes` are things that a person should know about how it was read."""

    name: str
    source: str
    licence: str
    links: dict[str, TreeLink]
    joints: tuple[TreeJoint, ...]
    notes: tuple[str, ...] = ()

    def link(self, name: str) -> TreeLink:
        """The link called `name`; raises `UnknownName`."""
        if name not in self.links:
            raise UnknownNameError("link", name, tuple(self.links), owner=self.source)
        return self.links[name]

    def joint(self, name: str) -> TreeJoint:
        """The joint called `name`; raises `UnknownName`."""
        for joint in self.joints:
            if joint.name == name:
                return joint
        raise UnknownNameError("joint", name, tuple(joint.name for joint in self.joints), owner=self.source)

    @property
    def root(self) -> str:
        """The one link that is nobody's child."""
        children = {joint.child for joint in self.joints}
        return next(name for name in self.links if name not in children)

    def validate(self) -> KinematicTree:
        """This tree, if it is one.

        Raises:
            InvalidSetup: a joint names a link that is not there, a link has two parents, or there is not one root.
        """
        children: dict[str, str] = {}
        for joint in self.joints:
            for end in (joint.parent, joint.child):
                if end not in self.links:
                    raise ConfigurationError(
                        f"link of {joint.name!r} ({joint.source_location})", got=end, allowed="a link of the file"
                    )
            if joint.child in children:
                got = f"child of {children[joint.child]!r} and {joint.name!r}"
                raise ConfigurationError(
                    f"link {joint.child!r} ({joint.source_location})", got=got, allowed="one parent each"
                )
            children[joint.child] = joint.name
        roots = [name for name in self.links if name not in children]
        if len(roots) != 1 or len(self.joints) != len(self.links) - 1:
            raise ConfigurationError(f"links of {self.source}", got=f"roots {roots}", allowed="one tree with one root")
        return self


def axis_rotation(axis: Array, angle: float) -> Array:
    """Rotation (3, 3) by `angle` [rad] about the unit vector `axis`: R = I + sin θ K + (1 − cos θ) K² (Rodrigues)."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * (K @ K)
