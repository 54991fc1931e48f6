"""Independent kinematics and distances in numpy and float64, without use of the kernel, vectorised over time."""

import numpy as np
from scipy.spatial.transform import Rotation

from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace, Sphere


def rotation_matrix(quaternion):
    w, x, y, z = quaternion
    return Rotation.from_quat([x, y, z, w]).as_matrix()


def joint_frames(body, q):
    """Rotations (t, 3, 3) and origins (t, 3) of frames 0..n for postures q (t, n)."""
    R, p = np.broadcast_to(np.eye(3), (len(q), 3, 3)), np.zeros((len(q), 3))
    out = [(R, p)]
    for k, joint in enumerate(body.joints):
        p = p + R @ np.array(joint.translation)
        spin = Rotation.from_rotvec(q[:, k : k + 1] * np.array([[0.0, 0.0, 1.0]])).as_matrix()
        R = R @ rotation_matrix(joint.quaternion) @ spin
        out.append((R, p))
    return out


def sphere_centres(body, q, opening=0.0):
    """Sphere centres (t, k, 3) in the order of the links, radii (k,) and link names."""
    chain, parts, radii, names = joint_frames(body, q), [], [], []
    for link in body.links:
        R, p = chain[link.frame]
        for sphere in (s for s in body.spheres if s.link == link.name):
            local = np.array(sphere.centre) + opening * np.array(link.slide)
            local = np.array(link.translation) + rotation_matrix(link.quaternion) @ local
            parts.append(p + R @ local)
            radii.append(sphere.radius)
            names.append(link.name)
    return np.stack(parts, axis=1), np.array(radii), names


def surface_distance(shape, pose, points):
    """Signed distance of points (..., 3) to the surface of a shape."""
    local = (points - np.array(pose.position)) @ rotation_matrix(pose.quaternion)
    match shape:
        case Sphere(radius=r):
            return np.linalg.norm(local, axis=-1) - r
        case Capsule(radius=r, half_length=h):
            local = local.copy()
            local[..., 2] = np.sign(local[..., 2]) * np.maximum(np.abs(local[..., 2]) - h, 0.0)
            return np.linalg.norm(local, axis=-1) - r
        case Box(half_extents=e):
            out = np.abs(local) - np.array(e)
            return np.linalg.norm(np.maximum(out, 0.0), axis=-1) + np.minimum(out.max(axis=-1), 0.0)
        case HalfSpace():
            return local[..., 2]


def h_obstacles(body, q, obstacles, opening=0.0, shifts=None):
    """Smallest gap (t,) between moving spheres and obstacles; `shifts` (t, k, 3) move the obstacles."""
    c, r, names = sphere_centres(body, q, opening)
    moving = [i for i, name in enumerate(names) if next(x.frame for x in body.links if x.name == name) > 0]
    c, r = c[:, moving], r[moving]
    least = np.full(len(q), np.inf)
    for k, obstacle in enumerate(obstacles):
        points = c if shifts is None else c - shifts[:, k, None, :]
        least = np.minimum(least, (surface_distance(obstacle.shape, obstacle.pose, points) - r).min(axis=1))
    return least


def h_self(body, q, opening=0.0):
    """Smallest gap (t,) over the kept link pairs."""
    c, r, names = sphere_centres(body, q, opening)
    names = np.array(names)
    least = np.full(len(q), np.inf)
    for first, second in body.self_pairs.kept:
        for i in np.flatnonzero(names == first):
            j = np.flatnonzero(names == second)
            gap = np.linalg.norm(c[:, i, None] - c[:, j], axis=2) - r[i] - r[j]
            least = np.minimum(least, gap.min(axis=1))
    return least


def h_joints(body, q):
    """Smallest distance (t,) to a joint limit [rad]."""
    low = np.array([joint.lower.value for joint in body.joints])
    high = np.array([joint.upper.value for joint in body.joints])
    return np.minimum(q - low, high - q).min(axis=1)
