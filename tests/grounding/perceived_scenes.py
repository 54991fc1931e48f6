"""Perceived scenes for tests of scene rules and scene summary."""

import msgspec
import numpy as np

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Bowl, Box, Capsule, HalfSpace, Pose
from dualbrain.records import Place, Scene, SceneObject

TABLE = SceneObject(name="table", role="support", shape=HalfSpace(), pose=Pose((0.0, 0.0, 0.0)))


def yaw_quaternion(yaw):
    return (float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2)))


def box(name, x, y, half=(0.02, 0.02, 0.025), role="object", yaw=0.0, z=None, **fields):
    height = half[2] if z is None else z
    return SceneObject(
        name=name,
        role=role,
        shape=Box(half),
        pose=Pose((float(x), float(y), float(height)), yaw_quaternion(yaw)),
        **fields,
    )


def bowl(x=0.5, y=0.26):
    return SceneObject(
        name="blue_bowl", role="container", shape=Bowl(0.085, 0.05, 0.004), pose=Pose((float(x), float(y), 0.0))
    )


def forearm(x, y, velocity=(0.0, 0.0, 0.0)):
    horizontal = (2**-0.5, 0.0, 2**-0.5, 0.0)
    return SceneObject(
        name="forearm", role="person", shape=Capsule(0.045, 0.25), pose=Pose((x, y, 0.2), horizontal), velocity=velocity
    )


def scene(*objects, places=()):
    return Scene(
        robot="panda",
        stamp=0.0,
        version=1,
        objects=(TABLE, *objects),
        places=tuple(Place(name, at) for name, at in places),
    )


def rotate_scene(one, yaw):
    """The scene `one` rotated about the robot's base by `yaw` [rad]."""
    turn = quaternion_to_matrix(yaw_quaternion(yaw))

    def moved(obj):
        position = tuple((turn @ np.array(obj.pose.position)).tolist())
        pose = Pose(position, quaternion_product(yaw_quaternion(yaw), obj.pose.quaternion))
        velocity = tuple((turn @ np.array(obj.velocity)).tolist())
        return msgspec.structs.replace(obj, pose=pose, velocity=velocity)

    return msgspec.structs.replace(one, objects=tuple(moved(obj) for obj in one.objects))


def quaternion_product(a, b):
    """Hamilton product of two quaternions (w, x, y, z)."""
    w, x, y, z = a
    W, X, Y, Z = b
    return (
        w * W - x * X - y * Y - z * Z,
        w * X + x * W + y * Z - z * Y,
        w * Y - x * Z + y * W + z * X,
        w * Z + x * Y - y * X + z * W,
    )
