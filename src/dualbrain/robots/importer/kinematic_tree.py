"""Kinematic tree of a robot description: links with shapes, and joints with limits and the line of the file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.untrusted.bounded_process import ProcessFailure, ProcessLimits, run_bounded
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.assets import mesh_primitives
from dualbrain.robots.assets.mesh_paths import AllowedFolders, allowed_folders
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
    the effort in N m or N. `source_location` is file and line, for the provenance. `soft_lower` and `soft_upper` are
    the range in which a joint of the chain is to stay, and `soft_location` its file and line.
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
    soft_lower: float | None = None
    soft_upper: float | None = None
    soft_location: str = ""

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
            ConfigurationError: A joint names a link that does not exist, a link has two parents, there is not exactly
                one root, or a number of a joint is not finite.
        """
        parent_joints: dict[str, str] = {}
        for joint in self.joints:
            _require_finite(joint)
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


def _require_finite(joint: TreeJoint) -> None:
    """Raise `ConfigurationError` if a number of `joint` is not finite; a limit that is not stated is None."""
    mimic = (joint.mimic.multiplier, joint.mimic.offset) if joint.mimic else ()
    limits = (joint.lower, joint.upper, joint.velocity, joint.acceleration, joint.jerk, joint.effort)
    soft = (joint.soft_lower, joint.soft_upper)
    stated = [limit for limit in (*limits, *soft) if limit is not None]
    for entry, values in (("pose", joint.pose), ("axis", joint.axis), ("limit", stated), ("mimic rule", mimic)):
        if not np.all(np.isfinite(values)):
            raise ConfigurationError(
                f"{entry} of joint {joint.name!r} ({joint.source_location})",
                got=np.asarray(values).tolist(),
                allowed="finite numbers",
            )


def axis_rotation(axis: Array, angle: float) -> Array:
    """Rotation (3, 3) by `angle` [rad] about the unit vector `axis`: R = I + sin θ K + (1 − cos θ) K² (Rodrigues)."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * (K @ K)


# --- reading in a process of its own --------------------------------------------------------------------------------

LIMITS = ProcessLimits()
"""Limits of the process that reads a description, and of each that reads a mesh."""
_SHAPES: dict[str, Callable[..., Mesh]] = {
    "box": mesh_primitives.box,
    "cylinder": mesh_primitives.cylinder,
    "capsule": mesh_primitives.capsule,
    "ellipsoid": mesh_primitives.ellipsoid,
}
_FILE, _TRIANGLES = "file", "triangles"


def file_shape(label: str, folders: AllowedFolders, name: str, where: str, scale: Array, pose: Array) -> LinkShape:
    """The shape in the mesh file called `name`, which is searched, read and refused when its mesh is loaded."""
    return LinkShape(label, partial(_load_file, folders, name, where, scale, pose))


def triangle_shape(label: str, vertices: Array, faces: NDArray[np.int64], pose: Array) -> LinkShape:
    """The shape of the triangles `faces` (f, 3) of `vertices` (v, 3) [m] at `pose` (4, 4)."""
    return LinkShape(label, partial(_place_triangles, vertices, faces, pose))


def read_in_process(function: str, file: Path, packages: tuple[Path, ...], data: bytes) -> KinematicTree:
    """The tree that `function` ("module:name") reads from the description `file` with the content `data`.

    The function gets an encoded triple (path, packages, content) and returns `encode_tree`. Raises `ConfigurationError`
    if the process exceeds its limits, and what the function raises.
    """
    argument = msgspec.msgpack.encode((str(file.absolute()), [str(one.absolute()) for one in packages], data))
    found = run_bounded(function, argument, LIMITS)
    if isinstance(found, ProcessFailure):
        sentence = f"The description {file.name} {found.reason}."
        raise ConfigurationError.stating(sentence, fix="Reduce its sizes, meshes, textures and repetitions.")
    return _decode_tree(found, allowed_folders(file, packages))


def encode_tree(tree: KinematicTree) -> bytes:
    """The whole tree; a shape becomes the name of its function with its arguments."""
    return msgspec.msgpack.encode(
        {
            "name": tree.name,
            "source": tree.source,
            "licence": tree.licence,
            "notes": tree.notes,
            "links": [
                (link.name, [_encode_shape(shape) for shape in link.shapes], link.uses_visual_shapes)
                for link in tree.links.values()
            ],
            "joints": [
                {name: _encode_value(getattr(joint, name)) for name in TreeJoint.__dataclass_fields__}
                for joint in tree.joints
            ],
        }
    )


def _decode_tree(data: bytes, folders: AllowedFolders) -> KinematicTree:
    parts: dict[str, Any] = msgspec.msgpack.decode(data)
    links = {
        name: TreeLink(name, tuple(_decode_shape(shape, folders) for shape in shapes), visual)
        for name, shapes, visual in parts["links"]
    }
    joints: list[TreeJoint] = []
    for fields in parts["joints"]:
        values = {name: _decode_value(value) for name, value in fields.items()}
        values["mimic"] = None if values["mimic"] is None else Mimic(*values["mimic"])
        joints.append(TreeJoint(**values))
    return KinematicTree(
        name=parts["name"],
        source=parts["source"],
        licence=parts["licence"],
        links=links,
        joints=tuple(joints),
        notes=tuple(parts["notes"]),
    )


def _encode_shape(shape: LinkShape) -> tuple[str, str, list[Any]]:
    load = cast("partial[Mesh]", shape.load_mesh)
    if load.func is _load_file:
        return shape.label, _FILE, [_encode_value(one) for one in load.args[1:]]
    if load.func is _place_triangles:
        return shape.label, _TRIANGLES, [_encode_value(one) for one in load.args]
    kind = next(name for name, function in _SHAPES.items() if function is load.func)
    return shape.label, kind, [_encode_value(one) for one in load.args]


def _decode_shape(encoded: Any, folders: AllowedFolders) -> LinkShape:
    label, kind, values = encoded
    arguments = [_decode_value(value) for value in values]
    if kind == _FILE:
        return LinkShape(label, partial(_load_file, folders, *arguments))
    return LinkShape(label, partial(_place_triangles if kind == _TRIANGLES else _SHAPES[kind], *arguments))


def _encode_value(value: Any) -> Any:
    """An array as its type, shape and bytes; a mimic rule as its fields; anything else unchanged."""
    if isinstance(value, np.ndarray):
        array = np.ascontiguousarray(cast("NDArray[Any]", value))
        return {"dtype": array.dtype.str, "shape": list(array.shape), "data": array.tobytes()}
    if isinstance(value, Mimic):
        return [value.leader, value.multiplier, value.offset]
    return cast("Any", value).item() if isinstance(value, np.generic) else value


def _decode_value(value: Any) -> Any:
    if isinstance(value, dict):
        array = cast("dict[str, Any]", value)
        return np.frombuffer(array["data"], np.dtype(array["dtype"])).reshape(array["shape"]).copy()
    return value


def _load_file(folders: AllowedFolders, name: str, where: str, scale: Array, pose: Array) -> Mesh:
    return mesh_primitives.load_mesh(folders.find(name, where), scale, pose, LIMITS)


def _place_triangles(vertices: Array, faces: NDArray[np.int64], pose: Array) -> Mesh:
    return mesh_primitives.apply_pose(Mesh(vertices, faces), pose)
