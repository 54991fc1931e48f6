"""Reader of URDF files: yourdfpy parses the file after the safe XML reader has accepted it.

lxml gives the lines for the provenance, and the limits of acceleration and jerk, which plain URDF does not have:
Drake's attributes `drake:acceleration` and `drake:jerk` of `<limit>`. The range in `<safety_controller>` is read too.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError
from dualbrain.robots.assets import mesh_primitives
from dualbrain.robots.assets.mesh_paths import AllowedFolders, allowed_folders
from dualbrain.robots.assets.safe_xml import parse_xml, read_bounded, undeclared_namespace
from dualbrain.robots.importer.kinematic_tree import (
    MOVABLE_JOINT_KINDS,
    KinematicTree,
    LinkShape,
    Mimic,
    TreeJoint,
    TreeLink,
    encode_tree,
    file_shape,
    read_in_process,
)
from dualbrain.robots.optional_imports import import_optional

Array = NDArray[np.float64]

JOINT_KINDS = ("fixed", "revolute", "continuous", "prismatic", "planar", "floating")
DRAKE_NAMESPACES = ("http://drake.mit.edu", undeclared_namespace("drake"))
"""Namespaces of Drake's extensions of URDF; many files use the prefix `drake` without declaring it."""


def read_urdf(file: Path, packages: Sequence[Path] = ()) -> KinematicTree:
    """The robot in the URDF `file`; its meshes are searched beside it and in `packages`, and are loaded on demand.

    Raises:
        ConfigurationError: The file is refused by the safe XML reader, not a URDF, or not a tree of joints.
        MissingDependencyError: A library is not installed.
    """
    return read_in_process("dualbrain.robots.importer.urdf:encode_urdf", file, tuple(packages), read_bounded(file))


def prepare_process(_: str) -> None:
    """Import the packages that read a URDF."""
    import_optional("lxml.etree")
    import_optional("yourdfpy")


def encode_urdf(argument: bytes) -> bytes:
    """The encoded tree of a URDF, for `read_in_process`."""
    name, packages, data = msgspec.msgpack.decode(argument, type=tuple[str, list[str], bytes])
    return encode_tree(_read_tree(parse_xml(data, Path(name).name), Path(name), [Path(one) for one in packages]))


def _read_tree(root: Any, file: Path, packages: Sequence[Path]) -> KinematicTree:
    if root.tag != "robot":
        raise ConfigurationError(
            f"root element of {file.name}", got=f"<{root.tag}>", allowed="<robot>, or <mujoco> in MJCF"
        )
    if root.xpath("boolean(//*[contains(namespace-uri(), 'xacro')])"):
        raise ConfigurationError.stating(
            f"{file.name} contains xacro macros.", fix="Expand them first: xacro FILE > OUT"
        )
    robot = _parse(root, file)
    elements = {(element.tag, element.get("name")): element for element in root.iterchildren("joint", "link")}
    folders = allowed_folders(file, packages)
    links = [_read_link(link, folders, f"{file.name}:{elements['link', link.name].sourceline}") for link in robot.links]
    joints = [_read_joint(joint, elements["joint", joint.name], file.name) for joint in robot.joints]
    _check_unique(file, "link", [link.name for link in links])
    _check_unique(file, "joint", [joint.name for joint in joints])
    visual = [link.name for link in links if link.uses_visual_shapes]
    notes = (f"links without collision shapes, whose visual shapes are used: {', '.join(visual)}",) if visual else ()
    return KinematicTree(
        name=robot.name or file.stem,
        source=file.name,
        licence=_licence(folders),
        links={link.name: link for link in links},
        joints=tuple(joints),
        notes=notes,
    ).validate()


def _parse(root: Any, file: Path) -> Any:
    """The robot as yourdfpy reads it from the checked element `root`."""
    logging.getLogger("yourdfpy").setLevel(logging.CRITICAL)
    data = BytesIO(import_optional("lxml.etree").tostring(root))
    try:
        reader = import_optional("yourdfpy").URDF.load(data, build_scene_graph=False, load_meshes=False)
    except (ValueError, TypeError, AttributeError, LookupError, ArithmeticError) as error:
        raise ConfigurationError(file.name, got=f"{type(error).__name__}: {error}"[:300], allowed="a URDF") from error
    return reader.robot


def _check_unique(file: Path, kind: str, names: list[str]) -> None:
    duplicates = sorted({name for name in names if names.count(name) > 1})
    if duplicates:
        raise ConfigurationError(
            f"{kind}s of {file.name}", got=f"{duplicates} more than once", allowed="each name once"
        )


def _licence(folders: AllowedFolders) -> str:
    """The licence in the package.xml of the description."""
    package = folders.package_folder / "package.xml"
    if not package.is_file():
        return "not stated by the description"
    licences = [element.text or "" for element in parse_xml(read_bounded(package), package.name).iter("license")]
    return ", ".join(licence.strip() for licence in licences if licence.strip()) or "not stated by its package.xml"


# --- links --------------------------------------------------------------------------------------------------------


def _read_link(link: Any, folders: AllowedFolders, where: str) -> TreeLink:
    shapes = tuple(_read_shape(shape, folders, where) for shape in link.collisions)
    if shapes:
        return TreeLink(link.name, shapes)
    visual = tuple(_read_shape(shape, folders, where) for shape in link.visuals)
    return TreeLink(link.name, visual, bool(visual))


def _read_shape(shape: Any, folders: AllowedFolders, where: str) -> LinkShape:
    geometry, pose = shape.geometry, _read_pose(shape.origin, where)
    if geometry is None:
        raise ConfigurationError(f"shape at {where}", got="no geometry", allowed="box, cylinder, sphere or mesh")
    if geometry.box is not None:
        size = _finite_numbers(geometry.box.size, 3, where)
        return LinkShape("box", partial(mesh_primitives.box, size / 2.0, pose))
    if geometry.cylinder is not None:
        radius, length = _finite_numbers([geometry.cylinder.radius, geometry.cylinder.length], 2, where)
        return LinkShape("cylinder", partial(mesh_primitives.cylinder, float(radius), float(length) / 2.0, pose))
    if geometry.sphere is not None:
        (radius,) = _finite_numbers([geometry.sphere.radius], 1, where)
        return LinkShape("sphere", partial(mesh_primitives.ellipsoid, np.full(3, float(radius)), pose))
    if geometry.mesh is None:
        raise ConfigurationError(f"shape at {where}", got="unknown geometry", allowed="box, cylinder, sphere or mesh")
    name = str(geometry.mesh.filename)
    scale = np.ones(3) if geometry.mesh.scale is None else _read_scale(geometry.mesh.scale, where)
    return file_shape(f"mesh {name}", folders, name, where, scale, pose)


def _read_scale(value: Any, where: str) -> Array:
    factors = np.atleast_1d(np.asarray(value, float))
    return _finite_numbers(np.broadcast_to(factors, (3,)) if factors.size == 1 else factors, 3, where)


# --- joints -------------------------------------------------------------------------------------------------------


def _read_joint(joint: Any, element: Any, file: str) -> TreeJoint:
    """The `joint` that yourdfpy read from the XML `element` of the file called `file`."""
    where = f"{file}:{element.sourceline}"
    if joint.type not in JOINT_KINDS:
        raise ConfigurationError(
            f"type of joint {joint.name!r} ({where})", got=joint.type, allowed=", ".join(JOINT_KINDS)
        )
    axis = _finite_numbers([1.0, 0.0, 0.0] if joint.axis is None else joint.axis, 3, where)
    norm = float(np.linalg.norm(axis))
    if joint.type in MOVABLE_JOINT_KINDS and norm < 1e-9:
        raise ConfigurationError(f"axis of joint {joint.name!r} ({where})", got=axis.tolist(), allowed="not zero")
    limit, limit_element = joint.limit, element.find("limit")
    bounded = joint.type in ("revolute", "prismatic")
    lower, upper, velocity = (
        (None, None, None) if limit is None else (_optional_number(value, where) for value in _limits(limit, bounded))
    )
    soft_lower, soft_upper = _soft_limits(joint.safety_controller, where)
    soft_element = element.find("safety_controller")
    return TreeJoint(
        name=joint.name,
        kind=joint.type,
        parent=joint.parent,
        child=joint.child,
        pose=_read_pose(joint.origin, where),
        axis=axis / norm if norm > 0.0 else axis,
        source_location=where,
        lower=lower,
        upper=upper,
        velocity=velocity,
        acceleration=_drake_limit(limit_element, "acceleration", where),
        jerk=_drake_limit(limit_element, "jerk", where),
        mimic=_read_mimic(joint.mimic),
        effort=None if limit is None else _optional_number(limit.effort, where),
        soft_lower=soft_lower,
        soft_upper=soft_upper,
        soft_location="" if soft_element is None else f"{file}:{soft_element.sourceline}",
    )


def _read_mimic(mimic: Any) -> Mimic | None:
    if mimic is None:
        return None
    multiplier = 1.0 if mimic.multiplier is None else float(mimic.multiplier)
    return Mimic(str(mimic.joint), multiplier, 0.0 if mimic.offset is None else float(mimic.offset))


def _drake_limit(element: Any, name: str, where: str) -> float | None:
    """The number in Drake's attribute `name` of the `<limit>` element, None if there is none."""
    texts = [] if element is None else [element.get(f"{{{namespace}}}{name}") for namespace in DRAKE_NAMESPACES]
    text = next((text for text in texts if text is not None), None)
    try:
        return _optional_number(text, where)
    except ValueError as error:
        raise ConfigurationError(f"drake:{name} at {where}", got=text, allowed="a finite number") from error


def _limits(limit: Any, bounded: bool) -> tuple[Any, Any, Any]:
    """Lower, upper and velocity limit; an omitted range, which URDF defines as [0, 0], counts as not stated."""
    lower, upper = (limit.lower or 0.0, limit.upper or 0.0) if bounded else (None, None)
    return (None, None, limit.velocity) if lower == upper else (lower, upper, limit.velocity)


def _soft_limits(controller: Any, where: str) -> tuple[float | None, float | None]:
    """The range in a `<safety_controller>`; without a range, which URDF defines as [0, 0], it is not stated."""
    if controller is None or (controller.soft_lower_limit or 0.0) == (controller.soft_upper_limit or 0.0):
        return None, None
    return _optional_number(controller.soft_lower_limit, where), _optional_number(controller.soft_upper_limit, where)


def _optional_number(value: Any, where: str) -> float | None:
    return None if value is None else float(_finite_numbers([value], 1, where)[0])


def _read_pose(origin: Any, where: str) -> Array:
    if origin is None:
        return np.eye(4)
    return _finite_numbers(np.ravel(origin), 16, where).reshape(4, 4)


def _finite_numbers(values: Any, count: int, where: str) -> Array:
    """`values` as an array of `count` finite numbers."""
    numbers = np.asarray(values, float).ravel()
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ConfigurationError(f"numbers at {where}", got=numbers.tolist()[:8], allowed=f"{count} finite numbers")
    return numbers
