"""The collision geometry of a MuJoCo model as obstacles of the filter, in the frame of an arm's base.

Every geom that collides and is no part of the arm becomes an obstacle: planes, spheres, capsules and boxes as they are,
cylinders, ellipsoids, meshes and height fields as the box around them, which is larger. A geom that is fixed to the
world is static; any other one has the velocity of its centre, and the speed of its surface about it as the error.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace, Pose, Sphere
from dualbrain.safety.cbf.obstacles import Obstacle, Solid
from dualbrain.simulation.environments.mujoco_arm import MujocoArm

Array = NDArray[np.float64]
MIN_SIZE = 1e-4
"""Smallest half extent of an obstacle [m]: a flat mesh has a box without thickness."""


class MujocoObstacles:
    """Obstacles from the geoms around an arm, at the present state of the simulation."""

    def __init__(self, arm: MujocoArm, *, ignored: Collection[str] = (), margin: float = 0.0) -> None:
        """All colliding geoms that are no part of `arm` nor of a body in `ignored`, enlarged by `margin` [m].

        Bodies that the policy is to touch belong into `ignored`; the filter then does not know them.
        """
        self._arm, self._margin, model = arm, margin, arm.model
        own = arm.bodies
        self._geoms = [
            geom
            for geom in range(model.ngeom)
            if (model.geom_contype[geom] or model.geom_conaffinity[geom])
            and int(model.geom_bodyid[geom]) not in own
            and model.body(int(model.geom_bodyid[geom])).name not in ignored
        ]
        self._shapes = {geom: _shape_of(model, geom) for geom in self._geoms}

    def observe(self) -> list[Obstacle]:
        """The obstacles at the present positions and velocities."""
        return [self._obstacle(geom) for geom in self._geoms]

    def _obstacle(self, geom: int) -> Obstacle:
        model, data = self._arm.model, self._arm.data
        rotation = data.geom_xmat[geom].reshape(3, 3)
        shape, offset = self._shapes[geom]
        position, turned = self._arm.to_base(data.geom_xpos[geom] + rotation @ offset, rotation)
        body = int(model.geom_bodyid[geom])
        fixed = model.body_weldid[body] == 0 and model.body_mocapid[body] < 0
        velocity, spread = (np.zeros(3), 0.0) if fixed else self._motion(geom, rotation @ offset)
        return Obstacle(
            name=f"{model.body(body).name or 'world'}/{model.geom(geom).name or geom}",
            shape=shape,
            pose=_pose(position, turned),
            velocity=_vector(velocity),
            velocity_error=spread,
            margin=self._margin,
            static=bool(fixed),
        )

    def _motion(self, geom: int, offset: Array) -> tuple[Array, float]:
        """Velocity (3,) of the obstacle's centre in the base frame, and the largest speed of its surface about it."""
        model, data, motion = self._arm.model, self._arm.data, np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_GEOM, geom, motion, 0)
        velocity = motion[3:] + np.cross(motion[:3], offset)
        turn = data.xmat[self._arm.base].reshape(3, 3).T
        return turn @ velocity, float(np.linalg.norm(motion[:3]) * _extent(self._shapes[geom][0]))


def _shape_of(model: Any, geom: int) -> tuple[Solid, Array]:
    """The shape of a geom and the offset (3,) of its centre in the frame of the geom [m]."""
    kind, size, here = int(model.geom_type[geom]), model.geom_size[geom], np.zeros(3)
    match kind:
        case mujoco.mjtGeom.mjGEOM_PLANE:
            return HalfSpace(), here
        case mujoco.mjtGeom.mjGEOM_SPHERE:
            return Sphere(float(size[0])), here
        case mujoco.mjtGeom.mjGEOM_CAPSULE:
            return Capsule(float(size[0]), float(size[1])), here
        case mujoco.mjtGeom.mjGEOM_BOX | mujoco.mjtGeom.mjGEOM_ELLIPSOID:
            return _box(size), here
        case mujoco.mjtGeom.mjGEOM_CYLINDER:
            return _box(np.array([size[0], size[0], size[1]])), here
        case _:
            box = model.geom_aabb[geom]
            return _box(box[3:]), np.array(box[:3])


def _box(half_extents: Array) -> Box:
    return Box(_vector(np.maximum(half_extents, MIN_SIZE)))


def _extent(shape: Solid) -> float:
    """Largest distance of a point of the shape from its centre [m]."""
    match shape:
        case Box(half_extents=extents):
            return float(np.linalg.norm(extents))
        case Capsule(half_length=length):
            return length
        case _:
            return 0.0


def _pose(position: Array, rotation: Array) -> Pose:
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(rotation).ravel())
    w, x, y, z = (quaternion / np.linalg.norm(quaternion)).tolist()
    return Pose(_vector(position), (w, x, y, z))


def _vector(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return (x, y, z)
