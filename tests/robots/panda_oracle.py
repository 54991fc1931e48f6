"""Independent reference for the model of the Panda: chain, limits and meshes read from its URDF."""

import xml.etree.ElementTree as ET
from functools import lru_cache

import numpy as np

from dualbrain.robots.assets.meshes import collision_mesh, description_folder
from dualbrain.robots.collision_model.coverage import SphereSet
from dualbrain.robots.loader import load_robot

PANDA = load_robot("panda")
MESHES = {
    **{f"link{i}": f"link{i}" for i in range(8)},
    "hand": "hand",
    "left_finger": "finger",
    "right_finger": "finger",
}
URDF_NAMES = {
    **{f"link{i}": f"panda_link{i}" for i in range(8)},
    "hand": "panda_hand",
    "left_finger": "panda_leftfinger",
    "right_finger": "panda_rightfinger",
}
HALF_TURN = np.diag([-1.0, -1.0, 1.0])


@lru_cache
def urdf():
    return ET.parse(description_folder("panda") / "urdf" / "panda.urdf").getroot()


def roll_pitch_yaw(r, p, y):
    cr, sr, cp, sp, cy, sy = np.cos(r), np.sin(r), np.cos(p), np.sin(p), np.cos(y), np.sin(y)
    rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return rz @ ry @ rx


def axis_rotation(axis, angle):
    """Rodrigues' formula."""
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def urdf_pose(link, q, opening):
    """Pose (4, 4) of a URDF link in the root, by a walk from the link to the root."""
    values = {f"panda_joint{i + 1}": q[i] for i in range(7)}
    pose = np.eye(4)
    while (
        joint := next(
            (j for j in urdf().iter("joint") if j.find("child") is not None and j.find("child").get("link") == link),
            None,
        )
    ) is not None:
        origin = joint.find("origin")
        step = np.eye(4)
        step[:3, :3] = roll_pitch_yaw(*map(float, origin.get("rpy").split()))
        step[:3, 3] = list(map(float, origin.get("xyz").split()))
        if joint.get("type") != "fixed":
            axis = np.array(list(map(float, joint.find("axis").get("xyz").split())))
            move = np.eye(4)
            if joint.get("type") == "revolute":
                move[:3, :3] = axis_rotation(axis, values[joint.get("name")])
            else:
                move[:3, 3] = axis * opening
            step = step @ move
        pose = step @ pose
        link = joint.find("parent").get("link")
    return pose


def link_spheres(link):
    spheres = [sphere for sphere in PANDA.spheres if sphere.link == link]
    return SphereSet(np.array([sphere.centre for sphere in spheres]), np.array([sphere.radius for sphere in spheres]))


@lru_cache
def link_mesh(link):
    """Collision mesh in the link frame; the right finger is the left one rotated by 180° about z, as in the URDF."""
    mesh = collision_mesh("panda", MESHES[link])
    return type(mesh)(mesh.vertices @ HALF_TURN, mesh.faces) if link == "right_finger" else mesh
