"""The built-in MuJoCo model of the UR5e against the robot model, and its meshes against the filter's spheres."""

import mujoco
import numpy as np
import pytest

from dualbrain.robots.builtin import ur5e
from dualbrain.robots.loader import load_robot
from dualbrain.simulation.models.collision_hulls import arm_hulls, simplify_hull
from dualbrain.simulation.models.mujoco_model import load_mujoco_model
from tests.simulation.models.test_panda_model import transform, z_rotation

UR5E = load_robot("ur5e")
LINKS = [link.name for link in UR5E.links]


@pytest.fixture(scope="module")
def model():
    return load_mujoco_model("ur5e").spec.compile()


def test_kinematics_agree_with_the_robot_model(model):
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(50):
        q = rng.uniform([j.lower.value for j in UR5E.joints], [j.upper.value for j in UR5E.joints])
        data.qpos[:6] = q
        mujoco.mj_kinematics(model, data)
        T = np.eye(4)
        for joint, angle in zip(UR5E.joints, q, strict=True):
            T = T @ transform(joint.translation, joint.quaternion) @ z_rotation(angle)
        T = T @ transform(UR5E.tool.translation, UR5E.tool.quaternion)
        assert np.allclose(data.site("tcp").xpos, T[:3, 3], atol=1e-9)
        assert np.allclose(data.site("tcp").xmat.reshape(3, 3), T[:3, :3], atol=1e-9)


def test_limits_and_gravity_compensation(model):
    assert np.allclose(model.jnt_range[:6], [(j.lower.value, j.upper.value) for j in UR5E.joints], atol=1e-9)
    assert np.allclose(model.actuator_forcerange[:6, 1], [150] * 3 + [28] * 3)
    assert all(model.body_gravcomp[model.body(name).id] == 1.0 for name in LINKS[1:])
    assert model.jnt_range[6:8, 1] == pytest.approx(UR5E.gripper.opening.value)


def corners(model, geom):
    """Vertices (p, 3) of a mesh or a box in the frame of its link."""
    mesh = model.geom_dataid[geom]
    if mesh >= 0:
        first = model.mesh_vertadr[mesh]
        points = model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(float)
    else:
        points = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * model.geom_size[geom]
    place = transform(model.geom_pos[geom], model.geom_quat[geom])
    return points @ place[:3, :3].T + place[:3, 3]


@pytest.mark.parametrize("link", LINKS)
def test_the_spheres_of_the_filter_contain_meshes_they_were_not_fitted_to(model, link):
    """The vertices of a hull are checked; simplification and rounding leave a tolerance of 0.1 mm."""
    own = [sphere for sphere in UR5E.spheres if sphere.link == link]
    centres, radii = np.array([sphere.centre for sphere in own]), np.array([sphere.radius for sphere in own])
    geoms = [g for g in range(model.ngeom) if model.body(model.geom_bodyid[g]).name == link]
    points = np.vstack([corners(model, geom) for geom in geoms])
    points *= (-1, -1, 1) if link.startswith("right_") else 1  # MuJoCo's body is rotated, the link is not
    outside = np.min(np.linalg.norm(points[:, None] - centres, axis=2) - radii, axis=1).max()
    assert outside <= 1e-4
    assert outside > -0.02, "the spheres are not needlessly large"
    fitted = {
        tuple(point)
        for wanted in ur5e.LINK_COVERS.get(link, ())
        for point in ur5e.part_mesh(wanted.mesh).vertices.round(4)
    }
    assert not {tuple(point) for point in points.round(4)} <= fitted


def test_no_self_contact_at_home(model):
    data = mujoco.MjData(model)
    data.qpos[:6], data.qpos[6:8] = UR5E.home, UR5E.gripper.opening.value
    mujoco.mj_forward(model, data)
    assert data.ncon == 0


def test_a_simplified_hull_contains_every_vertex_within_its_tolerance():
    rng = np.random.default_rng(0)
    points = rng.standard_normal((400, 3))
    points /= np.linalg.norm(points, axis=1)[:, None]
    kept = simplify_hull(points, tolerance=0.05)
    from scipy.spatial import ConvexHull  # noqa: PLC0415

    planes = ConvexHull(kept).equations
    assert len(kept) < 200
    assert (points @ planes[:, :3].T + planes[:, 3]).max() <= 0.05 + 1e-9


def test_the_stored_meshes_are_those_that_the_command_generates(model):
    for name, points in arm_hulls().items():
        geom = model.geom(name).id
        stored = corners(model, geom)
        away = np.linalg.norm(stored[:, None] - points[None], axis=2).min(axis=1)
        assert away.max() < 2e-4
