"""The model of the Panda agrees with the URDF it comes from, and with the kinematics of MuJoCo."""

import mujoco
import numpy as np
import pytest

from dualbrain.robots.builtin.panda import HOME
from dualbrain.robots.collision_model.self_collision import chain_frames, random_configurations, sphere_centres
from tests.robots.panda_oracle import PANDA, URDF_NAMES, urdf, urdf_pose

CORNERS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


def link_points(q, opening):
    """Origin and unit points of each link in the world, from the robot model: (links, 4, 3)."""
    turns, origins = chain_frames(PANDA.joints, q[None])
    return np.array([sphere_centres(link, CORNERS, turns, origins, opening)[0] for link in PANDA.links])


@pytest.mark.parametrize("seed", range(8))
def test_the_chain_is_the_urdf_chain(seed):
    rng = np.random.default_rng(seed)
    q, opening = random_configurations(PANDA.joints, 1, rng)[0], 0.04 * rng.random()
    for link, points in zip(PANDA.links, link_points(q, opening), strict=True):
        pose = urdf_pose(URDF_NAMES[link.name], q, opening)
        assert np.allclose(points, CORNERS @ pose[:3, :3].T + pose[:3, 3], atol=1e-12)


def test_the_tool_frame_is_the_urdf_tcp():
    pose = urdf_pose("panda_hand_tcp", np.array(HOME), 0.0)
    hand = urdf_pose("panda_hand", np.array(HOME), 0.0)
    assert np.allclose(pose[:3, :3], hand[:3, :3])
    assert np.allclose(hand[:3, :3].T @ (pose[:3, 3] - hand[:3, 3]), PANDA.tool.translation)
    assert pose[2, 2] < 0
    assert np.allclose(PANDA.tool.quaternion, (1, 0, 0, 0))


def mujoco_chain():
    """The robot model as MJCF, for the kinematics of MuJoCo."""
    nested, closing = "", ""
    for i, joint in enumerate(PANDA.joints):
        pose = f'pos="{" ".join(map(str, joint.translation))}" quat="{" ".join(map(str, joint.quaternion))}"'
        links = [link for link in PANDA.links if link.frame == i + 1]
        sites = "".join(
            f'<site name="{link.name}" pos="{" ".join(map(str, link.translation))}" '
            f'quat="{" ".join(map(str, link.quaternion))}"/>'
            for link in links
        )
        nested += f'<body {pose}><joint axis="0 0 1"/><geom size="0.01" mass="1"/>{sites}'
        closing += "</body>"
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{nested}{closing}</worldbody></mujoco>")


def test_the_chain_agrees_with_mujoco():
    model = mujoco_chain()
    data = mujoco.MjData(model)
    for q in random_configurations(PANDA.joints, 50, np.random.default_rng(3)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        for link, points in zip(PANDA.links, link_points(q, 0.0), strict=True):
            if link.frame:
                site = data.site(link.name)
                assert np.allclose(points, CORNERS @ site.xmat.reshape(3, 3).T + site.xpos, atol=1e-9)


@pytest.mark.parametrize("joint", PANDA.joints, ids=lambda joint: joint.name)
def test_limits_are_those_of_the_urdf(joint):
    limit = next(j for j in urdf().iter("joint") if j.get("name") == joint.name).find("limit")
    for key in ("lower", "upper", "velocity"):
        assert getattr(joint, key).value == float(limit.get(key))


def test_the_opening_of_the_gripper_is_that_of_the_urdf():
    limit = next(j for j in urdf().iter("joint") if j.get("name") == "panda_finger_joint1").find("limit")
    assert PANDA.gripper.opening.value == float(limit.get("upper"))
    assert 0 < PANDA.gripper.force_min.value < PANDA.gripper.force.value <= 70.0


def test_accelerations_and_jerks_are_the_published_ones():
    assert [joint.acceleration.value for joint in PANDA.joints] == [15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0]
    assert [joint.jerk.value for joint in PANDA.joints] == [7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0]
