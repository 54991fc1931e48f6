"""The built-in MuJoCo model of the Panda against the robot model and the published meshes."""

import mujoco
import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from dualbrain.simulation.models.mujoco_model import load_mujoco_model
from dualbrain.simulation.models.visual_meshes import find_mesh_folder
from tests.simulation.scripted_hand import PANDA

G = mujoco.mjtGeom
LINKS = [*(f"link{i}" for i in range(8)), "hand", "left_finger", "right_finger"]


@pytest.fixture(scope="module")
def model():
    return load_mujoco_model("panda").spec.compile()


def chain(q):
    """Tool frame by forward kinematics of the robot model, independent of MuJoCo."""
    T = np.eye(4)
    for joint, angle in zip(PANDA.joints, q, strict=True):
        T = T @ transform(joint.translation, joint.quaternion) @ z_rotation(angle)
    hand = next(link for link in PANDA.links if link.name == PANDA.tool.link)
    return T @ transform(hand.translation, hand.quaternion) @ transform(PANDA.tool.translation, PANDA.tool.quaternion)


def transform(translation, quaternion):
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.array(quaternion))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = matrix.reshape(3, 3), translation
    return T


def z_rotation(angle):
    T = np.eye(4)
    T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return T


def test_kinematics_agree_with_the_robot_model(model):
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(50):
        q = rng.uniform([j.lower.value for j in PANDA.joints], [j.upper.value for j in PANDA.joints])
        data.qpos[:7] = q
        mujoco.mj_kinematics(model, data)
        T = chain(q)
        assert np.allclose(data.site("tcp").xpos, T[:3, 3], atol=1e-9)
        assert np.allclose(data.site("tcp").xmat.reshape(3, 3), T[:3, :3], atol=1e-9)


def test_joint_limits_agree_with_the_robot_model(model):
    assert np.allclose(model.jnt_range[:7], [(j.lower.value, j.upper.value) for j in PANDA.joints], atol=1e-9)


def test_torque_limits_and_gravity_compensation(model):
    drives = [model.actuator(f"actuator{i}").id for i in range(1, 8)]
    assert np.allclose(model.actuator_forcerange[drives, 1], [87] * 4 + [12] * 3)
    assert all(model.body_gravcomp[model.body(name).id] == 1.0 for name in LINKS[1:])


def surface(model, geom, *, dense=False):
    """Vertices (p, 3) of a primitive in the frame of its link; `dense` adds points on its surface."""
    size, kind = model.geom_size[geom], int(model.geom_type[geom])
    if kind == int(G.mjGEOM_CAPSULE):
        mesh = trimesh.creation.capsule(radius=size[0], height=2 * size[1])
    elif kind == int(G.mjGEOM_CYLINDER):
        mesh = trimesh.creation.cylinder(radius=size[0], height=2 * size[1])
    else:
        mesh = trimesh.creation.box(extents=2 * size)
    centre = 0.5 * (mesh.bounds[0] + mesh.bounds[1])
    place = transform(model.geom_pos[geom], model.geom_quat[geom])
    points = np.vstack([mesh.vertices, mesh.sample(3000, seed=0)]) if dense else mesh.vertices
    return (points - centre) @ place[:3, :3].T + place[:3, 3]


@pytest.mark.parametrize("link", LINKS)
def test_collision_shapes_are_inside_or_near_the_published_link(model, link):
    folder = find_mesh_folder("collision")
    assert folder is not None
    name = "finger" if link.endswith("finger") else link
    hull = ConvexHull(trimesh.load(folder / f"{name}.stl").vertices)
    geoms = [g for g in range(model.ngeom) if model.body(model.geom_bodyid[g]).name == link]
    points = np.vstack([surface(model, g) for g in geoms])
    outside = (points @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1)
    assert outside.max() <= 5e-3
    extent = np.ptp(points, axis=0) / np.ptp(hull.points, axis=0)
    assert extent.min() > 0.65, "the shapes must also fill the link"


PADS = ("left_pad", "right_pad")
"""The inner faces of the fingertips, whose sharp corners may be slightly outside the spheres."""


@pytest.mark.parametrize("link", LINKS)
def test_the_spheres_of_the_filter_contain_the_shapes_of_the_plant(model, link):
    """Otherwise the simulated robot would be larger than the robot that the filter protects."""
    own = [sphere for sphere in PANDA.spheres if sphere.link == link]
    centres, radii = np.array([sphere.centre for sphere in own]), np.array([sphere.radius for sphere in own])
    for geom in (g for g in range(model.ngeom) if model.body(model.geom_bodyid[g]).name == link):
        if model.geom_contype[geom] == 0:
            continue
        points = surface(model, geom, dense=True) * ((-1, -1, 1) if link == "right_finger" else 1)
        outside = np.min(np.linalg.norm(points[:, None] - centres, axis=2) - radii, axis=1).max()
        assert outside <= (5e-4 if model.geom(geom).name in PADS else 0.0), model.geom(geom).name


def test_no_self_contact_at_home(model):
    data = mujoco.MjData(model)
    data.qpos[:7], data.qpos[7:9] = PANDA.home, 0.04
    mujoco.mj_forward(model, data)
    assert data.ncon == 0
