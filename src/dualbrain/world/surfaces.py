"""The surfaces of a plant's robot, link by link, for pictures that MuJoCo does not draw."""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false, reportUnknownMemberType=false

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from dualbrain.linalg import matrix
from dualbrain.world.plant import Plant
from dualbrain.world.visual_meshes import Patch

Array = NDArray[np.float64]

COLLIDING = 3
"""Group of the geoms that collide; they are not shown where surface meshes lie over them."""
ROUND, QUARTER = 24, 6
"""Corners of a circle, and steps from the pole of a ball to its equator."""
BOX = np.array([(x, y, z) for z in (-1.0, 1.0) for y in (-1.0, 1.0) for x in (-1.0, 1.0)])
BOX_FACES = np.array(
    [(0, 2, 1), (1, 2, 3), (4, 5, 6), (5, 7, 6), (0, 1, 4), (1, 5, 4), (2, 6, 3), (3, 6, 7), (0, 4, 2), (2, 4, 6),
     (1, 3, 5), (3, 7, 5)]
)  # fmt: skip


def surfaces(plant: Plant) -> dict[str, tuple[Patch, ...]]:
    """Coloured triangles of every link in its own frame, by the names of the plant's body."""
    model = plant.model
    owners = {int(plant.data.body(part).id): name for name, part in plant.parts().items()}
    found: dict[str, list[Patch]] = {name: [] for name in owners.values()}
    dressed = {int(model.geom_bodyid[i]) for i in range(model.ngeom) if _is_mesh(model, i) and _group(model, i) == 2}
    for i in range(model.ngeom):
        owner = int(model.geom_bodyid[i])
        if owner in owners and not (owner in dressed and _group(model, i) == COLLIDING):
            patch = _patch(model, i)
            found[owners[owner]] += [patch] if patch else []
    return {name: tuple(patches) for name, patches in found.items()}


def _group(model: mujoco.MjModel, i: int) -> int:
    return int(model.geom_group[i])


def _is_mesh(model: mujoco.MjModel, i: int) -> bool:
    return int(model.geom_type[i]) == int(mujoco.mjtGeom.mjGEOM_MESH)


def _patch(model: mujoco.MjModel, i: int) -> Patch | None:
    """Geom `i` as triangles in its body's frame; None for a shape that no robot here is made of."""
    kind, size = mujoco.mjtGeom(int(model.geom_type[i])), np.asarray(model.geom_size[i])
    match kind:
        case mujoco.mjtGeom.mjGEOM_MESH:
            points, faces = _mesh(model, int(model.geom_dataid[i]))
        case mujoco.mjtGeom.mjGEOM_BOX:
            points, faces = BOX * size, BOX_FACES
        case mujoco.mjtGeom.mjGEOM_CYLINDER:
            radius, half = float(size[0]), float(size[1])
            points, faces = _turned(np.array([(0.0, -half), (radius, -half), (radius, half), (0.0, half)]))
        case mujoco.mjtGeom.mjGEOM_CAPSULE | mujoco.mjtGeom.mjGEOM_SPHERE:
            half = float(size[1]) if kind == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0
            arc = np.linspace(0.0, np.pi / 2, QUARTER + 1)
            cap = float(size[0]) * np.stack([np.cos(arc), np.sin(arc)], axis=1) + (0.0, half)
            points, faces = _turned(np.vstack([cap[::-1] * (1.0, -1.0), cap]))
        case _:
            return None
    placed = points @ matrix(tuple(np.asarray(model.geom_quat[i]).tolist())).T + np.asarray(model.geom_pos[i])
    material = int(model.geom_matid[i])
    red, green, blue, _ = (model.mat_rgba[material] if material >= 0 else model.geom_rgba[i]).tolist()
    return Patch((red, green, blue), placed.astype(np.float32), faces.astype(np.int32))


def _mesh(model: mujoco.MjModel, mesh: int) -> tuple[Array, NDArray[np.int64]]:
    first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    face, faces = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
    points = np.asarray(model.mesh_vert[first : first + count], np.float64)
    return points, np.asarray(model.mesh_face[face : face + faces], np.int64)


def _turned(profile: Array) -> tuple[Array, NDArray[np.int64]]:
    """The surface of a `profile` (k, 2) of radius and height, from below to above, turned about z."""
    k = len(profile)
    angles = 2.0 * np.pi * np.arange(ROUND) / ROUND
    radius, height = profile[:, 0], profile[:, 1]
    ring = np.stack([np.outer(np.cos(angles), radius), np.outer(np.sin(angles), radius)], axis=2)
    points = np.dstack([ring, np.tile(height, (ROUND, 1))]).reshape(-1, 3)
    faces: list[tuple[int, int, int]] = []
    for j in range(ROUND):
        here, there = j * k, (j + 1) % ROUND * k
        for i in range(k - 1):
            if radius[i] > 0.0:
                faces.append((here + i, there + i, here + i + 1))
            if radius[i + 1] > 0.0:
                faces.append((there + i, there + i + 1, here + i + 1))
    return points, np.array(faces, np.int64)
