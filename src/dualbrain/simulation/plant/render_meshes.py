"""Surface meshes of each link of a plant's robot, for renderers other than MuJoCo."""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false, reportUnknownMemberType=false

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.errors import MissingDependencyError
from dualbrain.simulation.models.visual_meshes import ColouredMesh
from dualbrain.simulation.plant.plant import Plant

Array = NDArray[np.float64]

SURFACE_GEOM_GROUP, COLLISION_GEOM_GROUP = 2, 3
"""Groups of the surfaces and of the collision geoms; the latter are not drawn on links that have surface meshes."""
DEFAULT_COLOUR = (0.5, 0.5, 0.5, 1.0)
"""Colour of a geom that has none of its own."""
CIRCLE_SEGMENTS = 24
"""Segments that approximate a circle."""


def link_meshes(plant: Plant) -> dict[str, tuple[ColouredMesh, ...]]:
    """Coloured triangles of every link in the link frame, by link name; raises `MissingDependencyError`."""
    model = plant.model
    owners = {int(plant.data.body(part).id): name for name, part in plant.link_body_names().items()}
    found: dict[str, list[ColouredMesh]] = {name: [] for name in owners.values()}
    with_meshes = {
        int(model.geom_bodyid[i])
        for i in range(model.ngeom)
        if _is_mesh(model, i) and _geom_group(model, i) == SURFACE_GEOM_GROUP
    }
    for i in range(model.ngeom):
        owner = int(model.geom_bodyid[i])
        if owner in owners and not (owner in with_meshes and _geom_group(model, i) == COLLISION_GEOM_GROUP):
            patch = _geom_mesh(model, i)
            found[owners[owner]] += [patch] if patch else []
    return {name: tuple(patches) for name, patches in found.items()}


def object_meshes(plant: Plant) -> dict[str, tuple[ColouredMesh, ...]]:
    """Coloured triangles of every object that has a surface besides its collision shape, by name, in its own frame.

    These are bowls, and the arm of a person with sleeve and hand. Raises `MissingDependencyError`.
    """
    model, found = plant.model, dict[str, list[ColouredMesh]]()
    names = {int(plant.data.body(name).id): name for name in plant.object_names}
    for i in range(model.ngeom):
        owner = int(model.geom_bodyid[i])
        if owner in names and _geom_group(model, i) == SURFACE_GEOM_GROUP and (patch := _geom_mesh(model, i)):
            found.setdefault(names[owner], []).append(patch)
    if plant.spec.mover is not None and (arm := plant.spec.mover.name) in found:
        found[arm] = [_in_geom_frame(model, arm, patch) for patch in found[arm]]
    return {name: tuple(patches) for name, patches in found.items()}


def _in_geom_frame(model: mujoco.MjModel, geom: str, patch: ColouredMesh) -> ColouredMesh:
    """`patch` in the frame of `geom` in place of that of its body; the pose of a person's arm is that of its geom."""
    turn = quaternion_to_matrix(tuple(np.asarray(model.geom(geom).quat).tolist()))
    points = (patch.points - np.asarray(model.geom(geom).pos)) @ turn
    return ColouredMesh(patch.colour, points.astype(np.float32), patch.faces)


def _geom_group(model: mujoco.MjModel, i: int) -> int:
    return int(model.geom_group[i])


def _is_mesh(model: mujoco.MjModel, i: int) -> bool:
    return int(model.geom_type[i]) == int(mujoco.mjtGeom.mjGEOM_MESH)


def _geom_mesh(model: mujoco.MjModel, i: int) -> ColouredMesh | None:
    """Geom `i` as triangles in the frame of its body; None for a geom type that robot models do not use."""
    creation = _import_trimesh()
    kind, (radius, half, _) = mujoco.mjtGeom(int(model.geom_type[i])), np.asarray(model.geom_size[i]).tolist()
    match kind:
        case mujoco.mjtGeom.mjGEOM_MESH:
            points, faces = _mesh_arrays(model, int(model.geom_dataid[i]))
        case mujoco.mjtGeom.mjGEOM_BOX:
            points, faces = _trimesh_arrays(creation.box(2.0 * np.asarray(model.geom_size[i])))
        case mujoco.mjtGeom.mjGEOM_CYLINDER:
            points, faces = _trimesh_arrays(creation.cylinder(radius, 2.0 * half, sections=CIRCLE_SEGMENTS))
        case mujoco.mjtGeom.mjGEOM_CAPSULE:
            points, faces = _trimesh_arrays(
                creation.capsule(2.0 * half, radius, count=(CIRCLE_SEGMENTS, CIRCLE_SEGMENTS))
            )
        case mujoco.mjtGeom.mjGEOM_SPHERE:
            points, faces = _trimesh_arrays(creation.icosphere(subdivisions=2, radius=radius))
        case mujoco.mjtGeom.mjGEOM_ELLIPSOID:
            points, faces = _trimesh_arrays(creation.icosphere(subdivisions=3))
            points = points * np.asarray(model.geom_size[i])
        case _:
            return None
    placed = points @ quaternion_to_matrix(tuple(np.asarray(model.geom_quat[i]).tolist())).T + np.asarray(
        model.geom_pos[i]
    )
    red, green, blue, _ = _colour(model, i).tolist()
    return ColouredMesh((red, green, blue), placed.astype(np.float32), faces.astype(np.int32))


def _colour(model: mujoco.MjModel, i: int) -> Array:
    """Colour (4,) of geom `i`: its own one, or that of its material if it has none, as MuJoCo renders it."""
    material, own = int(model.geom_matid[i]), np.asarray(model.geom_rgba[i], np.float64)
    return own if material < 0 or not np.array_equal(own, DEFAULT_COLOUR) else np.asarray(model.mat_rgba[material])


def _mesh_arrays(model: mujoco.MjModel, mesh: int) -> tuple[Array, NDArray[np.int64]]:
    first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    face, faces = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
    points = np.asarray(model.mesh_vert[first : first + count], np.float64)
    return points, np.asarray(model.mesh_face[face : face + faces], np.int64)


def _trimesh_arrays(shape: Any) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (p, 3) [m] and faces (t, 3) of a trimesh mesh."""
    return np.asarray(shape.vertices, np.float64), np.asarray(shape.faces, np.int64)


def _import_trimesh() -> Any:
    """The module of trimesh that creates shapes; trimesh is installed with viser."""
    try:
        from trimesh import creation  # noqa: PLC0415  (only for the live view)
    except ModuleNotFoundError as error:
        fix = "Install both with `pip install 'dualbrain[view]'`, or run with --headless."
        raise MissingDependencyError("trimesh, which comes with viser,", fix=fix) from error
    return creation
