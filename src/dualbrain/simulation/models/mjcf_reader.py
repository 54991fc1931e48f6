"""Reads a robot description in MJCF; MuJoCo compiles it after every referenced file was checked to be permitted.

MuJoCo's joints have no velocity or acceleration limits, so the user must state them. Several joints of one body become
a chain of links; the anchor and the reference position of a joint become part of its frame.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec
import mujoco
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.errors import ConfigurationError
from dualbrain.robots.assets import mesh_primitives
from dualbrain.robots.assets.mesh_paths import AllowedFolders, allowed_folders
from dualbrain.robots.assets.safe_xml import read_bounded, read_xml, require_size
from dualbrain.robots.importer.kinematic_tree import (
    JointKind,
    KinematicTree,
    LinkShape,
    Mimic,
    TreeJoint,
    TreeLink,
    axis_rotation,
    encode_tree,
    read_in_process,
    triangle_shape,
)

Array = NDArray[np.float64]

DIRECTORY_ATTRIBUTES = ("meshdir", "assetdir", "texturedir")
MAX_INCLUDE_DEPTH = 8
"""Permitted nesting depth of <include>."""
MAX_INCLUDES = 64
"""Permitted number of included files."""
REFUSED_ELEMENTS = ("extension", "plugin", "model")
MAX_ASSET_BYTES = 256 * 2**20
"""Bytes of one file that a description names."""
JOINT_KINDS: dict[int, JointKind] = {
    int(mujoco.mjtJoint.mjJNT_FREE): "floating",
    int(mujoco.mjtJoint.mjJNT_BALL): "floating",
    int(mujoco.mjtJoint.mjJNT_SLIDE): "prismatic",
    int(mujoco.mjtJoint.mjJNT_HINGE): "revolute",
}


def read_mjcf(file: Path, packages: Sequence[Path] = ()) -> KinematicTree:
    """The robot in the MJCF `file`; files that it references must be in its folder or in `packages`.

    Raises:
        ConfigurationError: the file is unsafe, loads a plugin, or MuJoCo cannot compile it.
        MissingDependencyError: a referenced file is missing.
    """
    read_bounded(file)
    return read_in_process("dualbrain.simulation.models.mjcf_reader:encode_mjcf", file, tuple(packages), b"")


def encode_mjcf(argument: bytes) -> bytes:
    """The encoded tree of an MJCF, for `read_in_process`."""
    name, packages, _ = msgspec.msgpack.decode(argument, type=tuple[str, list[str], bytes])
    return encode_tree(_read_tree(Path(name), [Path(one) for one in packages]))


def _read_tree(file: Path, packages: Sequence[Path]) -> KinematicTree:
    lines: dict[str, str] = {}
    _check_files(file, packages, lines)
    try:
        spec = mujoco.MjSpec.from_file(str(file))
        spec.compiler.usethread = False  # threads need memory in proportion to the processors of the machine
        model = spec.compile()
    except (ValueError, RuntimeError) as error:
        raise ConfigurationError(file.name, got=str(error)[:300], allowed="an MJCF that MuJoCo compiles") from error
    name = model.names[: model.names.index(b"\0")].decode() or file.stem
    return tree_of_model(model, name, file.name, range(1, model.nbody), lines)


def tree_of_model(
    model: Any, name: str, source: str, bodies: Iterable[int], lines: Mapping[str, str] = MappingProxyType({})
) -> KinematicTree:
    """The tree of `bodies` of a compiled `MjModel`, parents first.

    A body whose parent is left out gets the world as its parent. `source` names the description, and `lines` has the
    line of each joint in it, for the provenance of limits.

    Raises:
        ConfigurationError: a number of a joint is not finite, or a shape is of another kind than the filter knows.
    """
    links: dict[str, TreeLink] = {"world": _link(model, 0, "world")}
    joints: list[TreeJoint] = []
    for body in bodies:
        _add_body(model, body, links, joints, lines, source)
    drawn = [link.name for link in links.values() if link.uses_visual_shapes]
    notes = (f"no collision shapes, visual ones taken instead: {', '.join(drawn)}",) if drawn else ()
    return KinematicTree(
        name=name,
        source=source,
        licence="not stated by the description",
        links=links,
        joints=tuple(joints),
        notes=notes,
    ).validate()


# --- safety ---------------------------------------------------------------------------------------------------------


def _check_files(main: Path, packages: Sequence[Path], lines: dict[str, str]) -> None:
    """Raise for a referenced file that is not permitted or missing; record the source line of each joint in `lines`.

    The folders of meshes and textures apply to all files, wherever they are declared, so all includes are read first.
    """
    allowed = allowed_folders(main, packages)
    files: list[tuple[Path, Any]] = []
    _collect_includes(main, main, allowed, files, 0)
    folders: dict[str, str] = {}
    for file, root in files:
        for element in root.iter("compiler"):
            _add_folders(folders, element, f"{file.name}:{element.sourceline}")
    for file, root in files:
        for element in root.iter():
            where = f"{file.name}:{element.sourceline}"
            if element.tag in REFUSED_ELEMENTS:
                got = "a plugin" if element.tag != "model" else "another model"
                raise ConfigurationError(f"<{element.tag}> at {where}", got=got, allowed="plain MJCF")
            if element.tag == "joint" and element.get("name"):
                lines.setdefault(element.get("name"), where)
            folder = folders.get({"mesh": "meshdir", "texture": "texturedir"}.get(element.tag, ""), "")
            for key, name in element.attrib.items():
                if key.startswith("file") and name and element.tag != "include":
                    found = allowed.find(str(Path(folder or folders.get("assetdir", "")) / name), where)
                    require_size(found, MAX_ASSET_BYTES)


def _collect_includes(
    file: Path, main: Path, allowed: AllowedFolders, files: list[tuple[Path, Any]], depth: int
) -> None:
    """Append `file` and all files that it includes, with their root elements, to `files`."""
    if depth > MAX_INCLUDE_DEPTH:
        raise ConfigurationError(
            f"includes of {main.name}", got=f"more than {MAX_INCLUDE_DEPTH} levels", allowed="fewer"
        )
    if len(files) >= MAX_INCLUDES:
        raise ConfigurationError(f"includes of {main.name}", got=f"more than {MAX_INCLUDES}", allowed="fewer")
    root = read_xml(file)
    files.append((file, root))
    for element in root.iter("include"):
        if name := element.get("file"):
            found = allowed.find(name, f"{file.name}:{element.sourceline}")
            _collect_includes(found, main, allowed, files, depth + 1)


def _add_folders(folders: dict[str, str], compiler: Any, where: str) -> None:
    """Add the folders of one <compiler>; two different ones would let a file be checked in one, read in the other."""
    if compiler.get("strippath", "false") != "false":
        raise ConfigurationError(f"strippath at {where}", got=compiler.get("strippath"), allowed="false")
    for key in DIRECTORY_ATTRIBUTES:
        value = compiler.get(key)
        if value is None:
            continue
        if folders.setdefault(key, value) != value:
            raise ConfigurationError(f"{key} at {where}", got=value, allowed=f"{folders[key]!r} in every file")


# --- the tree -------------------------------------------------------------------------------------------------------


def _add_body(
    model: Any, body: int, links: dict[str, TreeLink], joints: list[TreeJoint], lines: Mapping[str, str], file: str
) -> None:
    """Add the link of `body`, and an intermediate link for each joint of `body` but the last."""
    name = _element_name(model, mujoco.mjtObj.mjOBJ_BODY, body) or f"body{body}"
    at = int(model.body_parentid[body])
    parent = _element_name(model, mujoco.mjtObj.mjOBJ_BODY, at) or f"body{at}"
    parent = parent if at and parent in links else "world"
    pose = _pose(model.body_pos[body], model.body_quat[body])
    first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
    for k in range(count):
        last = k == count - 1 and not model.jnt_pos[first + k].any()
        joints.append(_joint(model, first + k, parent, name if last else f"{name}:{k}", pose, lines, file))
        parent, pose = joints[-1].child, _translation(-model.jnt_pos[first + k])
        links[parent] = TreeLink(parent)
    if parent != name:
        joints.append(
            TreeJoint(
                name=f"{name}:fixed",
                kind="fixed",
                parent=parent,
                child=name,
                pose=pose,
                axis=np.zeros(3),
                source_location=file,
            )
        )
    links[name] = _link(model, body, name)


def _joint(model: Any, j: int, parent: str, child: str, pose: Array, lines: Mapping[str, str], file: str) -> TreeJoint:
    name = _element_name(model, mujoco.mjtObj.mjOBJ_JOINT, j) or f"joint{j}"
    kind = JOINT_KINDS[int(model.jnt_type[j])]
    axis = np.array(model.jnt_axis[j], float)
    frame = pose @ _translation(model.jnt_pos[j])
    limited = bool(model.jnt_limited[j])
    if kind in ("revolute", "prismatic"):
        reference = float(model.qpos0[model.jnt_qposadr[j]])
        back = np.eye(4)
        if kind == "revolute":
            back[:3, :3] = axis_rotation(axis, -reference)
        else:
            back[:3, 3] = -reference * axis
        frame = frame @ back
        kind = "continuous" if kind == "revolute" and not limited else kind
    lower, upper = (float(value) for value in model.jnt_range[j]) if limited else (None, None)
    return TreeJoint(
        name=name,
        kind=kind,
        parent=parent,
        child=child,
        pose=frame,
        axis=axis,
        source_location=lines.get(name, file),
        lower=lower,
        upper=upper,
        velocity=None,
        acceleration=None,
        mimic=_mimic(model, j),
    )


def _mimic(model: Any, j: int) -> Mimic | None:
    """The mimic relation of joint `j`: the first two coefficients of an equality constraint between joints."""
    for e in range(model.neq):
        if int(model.eq_type[e]) == int(mujoco.mjtEq.mjEQ_JOINT) and int(model.eq_obj1id[e]) == j:
            other = int(model.eq_obj2id[e])
            if other >= 0:
                offset, factor = (float(value) for value in model.eq_data[e][:2])
                return Mimic(_element_name(model, mujoco.mjtObj.mjOBJ_JOINT, other), factor, offset)
    return None


def _link(model: Any, body: int, name: str) -> TreeLink:
    """The link with its collision geoms, or without any its visual geoms; planes (the floor) are left out."""
    first, count = int(model.body_geomadr[body]), int(model.body_geomnum[body])
    solid = [g for g in range(first, first + count) if int(model.geom_type[g]) != int(mujoco.mjtGeom.mjGEOM_PLANE)]
    hard = [g for g in solid if model.geom_contype[g] or model.geom_conaffinity[g]]
    pieces = tuple(_piece(model, g) for g in hard or solid)
    return TreeLink(name, pieces, uses_visual_shapes=bool(pieces) and not hard)


def _piece(model: Any, g: int) -> LinkShape:
    pose = _pose(model.geom_pos[g], model.geom_quat[g])
    size = np.array(model.geom_size[g], float)
    kind = int(model.geom_type[g])
    if kind == int(mujoco.mjtGeom.mjGEOM_BOX):
        return LinkShape("box", partial(mesh_primitives.box, size, pose))
    if kind == int(mujoco.mjtGeom.mjGEOM_SPHERE):
        return LinkShape("sphere", partial(mesh_primitives.ellipsoid, np.full(3, size[0]), pose))
    if kind == int(mujoco.mjtGeom.mjGEOM_ELLIPSOID):
        return LinkShape("ellipsoid", partial(mesh_primitives.ellipsoid, size, pose))
    if kind == int(mujoco.mjtGeom.mjGEOM_CYLINDER):
        return LinkShape("cylinder", partial(mesh_primitives.cylinder, float(size[0]), float(size[1]), pose))
    if kind == int(mujoco.mjtGeom.mjGEOM_CAPSULE):
        return LinkShape("capsule", partial(mesh_primitives.capsule, float(size[0]), float(size[1]), pose))
    if kind != int(mujoco.mjtGeom.mjGEOM_MESH):
        raise ConfigurationError(
            f"geom {g}", got=mujoco.mjtGeom(kind).name, allowed="box, sphere, cylinder, capsule, mesh"
        )
    return _mesh(model, int(model.geom_dataid[g]), pose)


def _mesh(model: Any, m: int, pose: Array) -> LinkShape:
    vertices, faces = int(model.mesh_vertadr[m]), int(model.mesh_faceadr[m])
    points = np.array(model.mesh_vert[vertices : vertices + int(model.mesh_vertnum[m])], float)
    corners = np.array(model.mesh_face[faces : faces + int(model.mesh_facenum[m])], np.int64)
    return triangle_shape("mesh", points, corners, pose)


def _element_name(model: Any, kind: Any, index: int) -> str:
    return mujoco.mj_id2name(model, int(kind), index) or ""


def _pose(position: Array, quaternion: Array) -> Array:
    pose = _translation(position)
    pose[:3, :3] = quaternion_to_matrix([float(value) for value in quaternion])
    return pose


def _translation(position: Array) -> Array:
    pose = np.eye(4)
    pose[:3, 3] = position
    return pose
