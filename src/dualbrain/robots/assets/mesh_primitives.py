"""Triangle meshes of primitive shapes and of mesh files, which are read from bytes and cannot refer to other files."""

from __future__ import annotations

from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.untrusted.bounded_process import DEFAULT_LIMITS, ProcessFailure, ProcessLimits, run_bounded
from dualbrain.errors import ConfigurationError
from dualbrain.robots.assets.meshes import Mesh
from dualbrain.robots.assets.safe_xml import parse_xml, read_bounded
from dualbrain.robots.optional_imports import import_optional

Array = NDArray[np.float64]

MESH_FORMATS = (".stl", ".dae", ".obj", ".ply", ".off")
MAX_MESH_BYTES = 256 * 2**20
CIRCLE_SEGMENTS = 24
"""Number of corners of the polygon that replaces a circle; it is circumscribed, so that it contains the circle."""


def load_mesh(path: Path, scale: Array, pose: Array, limits: ProcessLimits = DEFAULT_LIMITS) -> Mesh:
    """The mesh in the file `path`, scaled by `scale` (3,) and moved by `pose` (4, 4); a process reads it.

    Raises:
        ConfigurationError: The format is not one of `MESH_FORMATS`, the file is too large or contains no triangles, or
            reading it exceeds the `limits`.
        MissingDependencyError: trimesh (or, for .dae, pycollada) is not installed.
    """
    suffix = path.suffix.lower()
    if suffix not in MESH_FORMATS:
        raise ConfigurationError(f"mesh {path.name}", got=suffix, allowed=", ".join(MESH_FORMATS))
    argument = msgspec.msgpack.encode((path.name, suffix, read_bounded(path, MAX_MESH_BYTES)))
    found = run_bounded("dualbrain.robots.assets.mesh_primitives:encode_mesh", argument, limits)
    if isinstance(found, ProcessFailure):
        raise ConfigurationError.stating(f"The mesh {path.name} {found.reason}.", fix="Use a mesh of fewer triangles.")
    vertices, faces = (np.frombuffer(one) for one in msgspec.msgpack.decode(found, type=tuple[bytes, bytes]))
    points, corners = vertices.reshape(-1, 3), faces.view(np.int64).reshape(-1, 3)
    return apply_pose(Mesh(points * scale, corners.copy()), pose)


def prepare_process(_: str) -> None:
    """Import the packages that read a mesh; one that is missing is reported where it is needed."""
    for package in ("trimesh", "lxml.etree", "collada"):
        if find_spec(package.partition(".")[0]) is not None:
            import_optional(package)


def encode_mesh(argument: bytes) -> bytes:
    """Vertices [m] (float64) and faces (int64) of an encoded triple of file name, suffix and content, as bytes."""
    name, suffix, data = msgspec.msgpack.decode(argument, type=tuple[str, str, bytes])
    mesh = _parse_mesh(data, name, suffix)
    faces = np.ascontiguousarray(mesh.faces, np.int64)
    return msgspec.msgpack.encode((np.ascontiguousarray(mesh.vertices, np.float64).tobytes(), faces.tobytes()))


def _parse_mesh(data: bytes, name: str, suffix: str) -> Mesh:
    if suffix == ".dae":
        parse_xml(data, name)
        import_optional("collada")
    try:
        loaded = import_optional("trimesh").load(BytesIO(data), file_type=suffix[1:], process=True)
        mesh = loaded if hasattr(loaded, "faces") else loaded.to_mesh()
        vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
    except (ValueError, LookupError, TypeError, AttributeError, SyntaxError, ArithmeticError) as error:
        raise ConfigurationError(f"mesh {name}", got=str(error)[:200], allowed="a readable mesh") from error
    if not len(faces) or not np.isfinite(vertices).all():
        raise ConfigurationError(f"mesh {name}", got=f"{len(faces)} triangles", allowed="finite triangles")
    return Mesh(vertices * _unit_length(mesh), faces)


def _unit_length(mesh: Any) -> float:
    """Length of the unit of the file [m]; formats without a unit are in metres, as in ROS."""
    units = getattr(mesh, "metadata", {}).get("units") or getattr(mesh, "units", None) or "meters"
    return float(str(units).split("*")[0]) if "*" in str(units) else 1.0


def box(half: Array, pose: Array) -> Mesh:
    """Mesh of a box with half extents `half` (3,) [m] at `pose` (4, 4)."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float) * half
    return apply_pose(thickened_hull_mesh(corners), pose)


def cylinder(radius: float, half_length: float, pose: Array) -> Mesh:
    """A prism that contains the cylinder along local z of `pose` (4, 4); lengths in metres."""
    rim, lift = _circle_points(radius), np.array([0.0, 0.0, half_length])
    return apply_pose(thickened_hull_mesh(np.vstack([rim + lift, rim - lift])), pose)


def capsule(radius: float, half_length: float, pose: Array) -> Mesh:
    """A polytope that contains the capsule along local z of `pose` (4, 4); lengths in metres."""
    points = _sphere_points(radius)
    upper, lower = points[points[:, 2] >= -1e-12], points[points[:, 2] <= 1e-12]
    lift = np.array([0.0, 0.0, half_length])
    return apply_pose(thickened_hull_mesh(np.vstack([upper + lift, lower - lift])), pose)


def ellipsoid(radii: Array, pose: Array) -> Mesh:
    """A polytope that contains the ellipsoid with semi-axes `radii` (3,) [m] at `pose` (4, 4)."""
    return apply_pose(thickened_hull_mesh(_sphere_points(1.0) * radii), pose)


def _circle_points(radius: float) -> Array:
    angles = 2.0 * np.pi * np.arange(CIRCLE_SEGMENTS) / CIRCLE_SEGMENTS
    return (
        radius
        / np.cos(np.pi / CIRCLE_SEGMENTS)
        * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(CIRCLE_SEGMENTS)])
    )


def _sphere_points(radius: float) -> Array:
    """Corners of a polytope that contains the sphere, symmetric about z = 0."""
    levels = np.pi * (np.arange(13) / 12.0 - 0.5)
    ring = _circle_points(1.0)
    corners = np.vstack([ring * np.cos(level) + np.array([0.0, 0.0, np.sin(level)]) for level in levels])
    hull = import_optional("scipy.spatial").ConvexHull(corners)
    inner = float(np.min(-np.asarray(hull.equations)[:, 3]))
    return radius / inner * corners


def thickened_hull_mesh(points: Array) -> Mesh:
    """The convex hull of `points` (p, 3) as a closed mesh; flat sets are thickened by 0.1 mm."""
    spatial = import_optional("scipy.spatial")
    try:
        hull = spatial.ConvexHull(points)
    except spatial.QhullError:
        cube_corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float) * 1e-4
        points = (points[:, None] + cube_corners[None]).reshape(-1, 3)
        hull = spatial.ConvexHull(points)
    used = np.asarray(hull.vertices)
    index = np.full(len(points), -1)
    index[used] = np.arange(len(used))
    faces = index[np.asarray(hull.simplices)]
    vertices = np.asarray(points[used], float)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    inward = np.einsum("fi,fi->f", np.cross(b - a, c - a), np.asarray(hull.equations)[:, :3]) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    return Mesh(vertices, np.asarray(faces, np.int64))


def apply_pose(mesh: Mesh, pose: Array) -> Mesh:
    """`mesh` moved by the rigid `pose` (4, 4)."""
    return Mesh(mesh.vertices @ pose[:3, :3].T + pose[:3, 3], mesh.faces)


def concatenate_meshes(meshes: list[Mesh]) -> Mesh:
    """One mesh of all vertices and faces of `meshes`."""
    starts = np.cumsum([0, *[len(mesh.vertices) for mesh in meshes]])
    vertices = np.vstack([mesh.vertices for mesh in meshes])
    return Mesh(vertices, np.vstack([mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]))
