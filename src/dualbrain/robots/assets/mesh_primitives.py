"""Shapes as triangle meshes: primitives, and mesh files read from bytes so that they can name no other file."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError
from dualbrain.robots.assets.meshes import Mesh
from dualbrain.robots.assets.safe_xml import parse_xml, read_bounded
from dualbrain.robots.optional_imports import import_optional

Array = NDArray[np.float64]

MESH_FORMATS = (".stl", ".dae", ".obj", ".ply", ".off")
MAX_MESH_BYTES = 256 * 2**20
CIRCLE_SEGMENTS = 24
"""Corners of the prism that stands for a circle; it is put around it, so that it contains the round shape."""


def load_mesh(path: Path, scale: Array, pose: Array) -> Mesh:
    """The mesh in `path`, scaled by `scale` (3,) and moved by `pose` (4, 4).

    Raises:
        InvalidSetup: the format is not one of `FORMATS`, the file is too large, or it holds no triangles.
        MissingPart: trimesh (or, for .dae, pycollada) is not installed.
    """
    kind = path.suffix.lower()
    if kind not in MESH_FORMATS:
        raise ConfigurationError(f"mesh {path.name}", got=kind, allowed=", ".join(MESH_FORMATS))
    data = read_bounded(path, MAX_MESH_BYTES)
    if kind == ".dae":
        parse_xml(data, path.name)
        import_optional("collada")
    try:
        raw = import_optional("trimesh").load(BytesIO(data), file_type=kind[1:], process=True)
        whole = raw if hasattr(raw, "faces") else raw.to_mesh()
        vertices, faces = np.asarray(whole.vertices, float), np.asarray(whole.faces, np.int64)
    except (ValueError, IndexError, KeyError, TypeError, AttributeError, SyntaxError) as error:
        raise ConfigurationError(f"mesh {path.name}", got=str(error)[:200], allowed="a readable mesh") from error
    if not len(faces) or not np.isfinite(vertices).all():
        raise ConfigurationError(f"mesh {path.name}", got=f"{len(faces)} triangles", allowed="finite triangles")
    return apply_pose(Mesh(vertices * _unit_length(whole) * scale, faces), pose)


def _unit_length(mesh: Any) -> float:
    """Length of the file's unit [m]; formats without a unit are in metres, as in ROS."""
    units = getattr(mesh, "metadata", {}).get("units") or getattr(mesh, "units", None) or "meters"
    return float(str(units).split("*")[0]) if "*" in str(units) else 1.0


def box(half: Array, pose: Array) -> Mesh:
    """A box with half extents (3,) [m]."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float) * half
    return apply_pose(thickened_hull_mesh(corners), pose)


def cylinder(radius: float, half_length: float, pose: Array) -> Mesh:
    """A prism around the cylinder along local z."""
    rim, lift = _circle_points(radius), np.array([0.0, 0.0, half_length])
    return apply_pose(thickened_hull_mesh(np.vstack([rim + lift, rim - lift])), pose)


def capsule(radius: float, half_length: float, pose: Array) -> Mesh:
    """A polytope around the capsule along local z."""
    ball = _sphere_points(radius)
    upper, lower = ball[ball[:, 2] >= -1e-12], ball[ball[:, 2] <= 1e-12]
    lift = np.array([0.0, 0.0, half_length])
    return apply_pose(thickened_hull_mesh(np.vstack([upper + lift, lower - lift])), pose)


def ellipsoid(radii: Array, pose: Array) -> Mesh:
    """A polytope around the ellipsoid with semi-axes (3,) [m]; a ball has three equal ones."""
    return apply_pose(thickened_hull_mesh(_sphere_points(1.0) * radii), pose)


def _circle_points(radius: float) -> Array:
    angles = 2.0 * np.pi * np.arange(CIRCLE_SEGMENTS) / CIRCLE_SEGMENTS
    return (
        radius
        / np.cos(np.pi / CIRCLE_SEGMENTS)
        * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(CIRCLE_SEGMENTS)])
    )


def _sphere_points(radius: float) -> Array:
    """Corners of a polytope that contains the ball, symmetric about z = 0."""
    levels = np.pi * (np.arange(13) / 12.0 - 0.5)
    ring = _circle_points(1.0)
    corners = np.vstack([ring * np.cos(level) + np.array([0.0, 0.0, np.sin(level)]) for level in levels])
    hull = import_optional("scipy.spatial").ConvexHull(corners)
    inner = float(np.min(-np.asarray(hull.equations)[:, 3]))
    return radius / inner * corners


def thickened_hull_mesh(points: Array) -> Mesh:
    """The convex hull of points (p, 3) as a closed mesh; flat or thin sets are thickened by 0.1 mm."""
    spatial = import_optional("scipy.spatial")
    try:
        hull = spatial.ConvexHull(points)
    except spatial.QhullError:
        around = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float) * 1e-4
        points = (points[:, None] + around[None]).reshape(-1, 3)
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
    """Several meshes as one."""
    starts = np.cumsum([0, *[len(mesh.vertices) for mesh in meshes]])
    vertices = np.vstack([mesh.vertices for mesh in meshes])
    return Mesh(vertices, np.vstack([mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]))
