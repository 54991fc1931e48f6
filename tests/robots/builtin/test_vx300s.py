"""The model of the ViperX 300 S agrees with the MJCF of gym-aloha, and its spheres cover its hulls and the fingers."""

from functools import lru_cache
from importlib import metadata

import mujoco
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import HalfSpace
from dualbrain.errors import ConfigurationError
from dualbrain.robots.builtin import vx300s
from dualbrain.robots.collision_model.coverage import SphereSet, are_covered
from dualbrain.robots.collision_model.polytope import sample_surface
from dualbrain.robots.collision_model.self_collision import chain_frames, random_configurations
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.simulation.models.mujoco_model import load_mujoco_model

VX300S = load_robot("vx300s")
LINK_OF_BODY = {
    "shoulder_link": "shoulder",
    "upper_arm_link": "upper_arm",
    "upper_forearm_link": "upper_forearm",
    "lower_forearm_link": "lower_forearm",
    "wrist_link": "wrist",
    "gripper_link": "gripper",
    "gripper_prop_link": "gripper",
    "left_finger_link": "fingers",
    "right_finger_link": "fingers",
}


@lru_cache
def mjcf():
    try:
        folder = metadata.distribution(vx300s.PACKAGE).locate_file("gym_aloha/assets")
    except metadata.PackageNotFoundError:
        pytest.skip(f"needs the data of {vx300s.PACKAGE}: pip install --no-deps {vx300s.PACKAGE}")
    return mujoco.MjModel.from_xml_path(str(folder / "bimanual_viperx_transfer_cube.xml"))


def simulation(q, fingers=(0.021, -0.021)):
    data = mujoco.MjData(mjcf())
    data.qpos[:8] = [*q, *fingers]
    mujoco.mj_kinematics(mjcf(), data)
    return data


@pytest.mark.parametrize("seed", range(4))
def test_the_chain_is_that_of_the_mjcf(seed):
    q = random_configurations(VX300S.joints, 1, np.random.default_rng(seed))[0]
    data, (turns, origins) = simulation(q), chain_frames(VX300S.joints, q[None])
    base = data.body("vx300s_left").xpos
    for frame, joint in enumerate(VX300S.joints, start=1):
        found = mjcf().joint(f"vx300s_left/{joint.name}").id
        np.testing.assert_allclose(turns[0, frame][:, 2], data.xaxis[found], atol=1e-9)
        np.testing.assert_allclose(origins[0, frame], data.xanchor[found] - base, atol=1e-9)


def test_ranges_are_those_of_the_mjcf_and_speeds_are_stated_as_policy():
    for joint in VX300S.joints:
        assert (joint.lower.value, joint.upper.value) == tuple(mjcf().joint(f"vx300s_left/{joint.name}").range)
        assert "site policy" in joint.velocity.provenance
        assert "site policy" in joint.acceleration.provenance


def hull_points(geom, data):
    """Points (k, 3) of the hull of a mesh geom in the world: its vertices, and random mixtures of three of them."""
    model, mesh = mjcf(), int(mjcf().geom_dataid[geom])
    first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    vertices, rng = model.mesh_vert[first : first + count], np.random.default_rng(geom)
    mixed = [weights @ vertices[rng.integers(count, size=3)] for weights in rng.dirichlet(np.ones(3), 2000)]
    return np.vstack([vertices, mixed]) @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]


@pytest.mark.parametrize("opening", [0.021, 0.03, 0.045, 0.057])
def test_the_spheres_contain_the_hulls_of_the_simulation(opening):
    q = random_configurations(VX300S.joints, 1, np.random.default_rng(7))[0]
    data = simulation(q, (opening, -opening))
    centres, radii, _ = SafetyFilter(VX300S).spheres(q, None)
    centres = centres + data.body("vx300s_left").xpos
    links = [sphere.link for sphere in VX300S.spheres]
    checked, uncovered = set(), 0
    for geom in range(mjcf().ngeom):
        side, _, body = mjcf().body(int(mjcf().geom_bodyid[geom])).name.partition("/")
        if side != "vx300s_left" or body not in LINK_OF_BODY:
            continue
        own = [k for k, link in enumerate(links) if link == LINK_OF_BODY[body]]
        points = hull_points(geom, data)
        assert are_covered(points, SphereSet(centres[own], radii[own]), tolerance=1e-4).all(), mjcf().geom(geom).name
        uncovered += not are_covered(points, SphereSet(centres[own], 0.9 * radii[own])).all()
        checked.add(body)
    assert checked == set(LINK_OF_BODY)
    assert uncovered >= 5, "smaller spheres would not do"


def test_the_base_is_covered():
    spheres = [sphere for sphere in VX300S.spheres if sphere.link == "base"]
    cover = SphereSet(np.array([s.centre for s in spheres]), np.array([s.radius for s in spheres]))
    mjcf()
    points = sample_surface(vx300s.link_shapes()["base"][0], 3000, np.random.default_rng(0))
    assert are_covered(points, cover, tolerance=1e-4).all()


def test_the_start_posture_of_gym_aloha_is_clear_of_the_table():
    safety = SafetyFilter(VX300S, obstacles=[Obstacle("table", HalfSpace(), parts=("arm", "hand", "fingers"))])
    result = safety(np.array(VX300S.home), np.zeros(6), np.zeros(6), 0.0)
    assert result.u == pytest.approx(np.zeros(6), abs=1e-9)
    assert result.h_min > 0.0


def test_it_is_identified_as_a_position_servo_and_has_no_plant():
    assert VX300S.tracking.drive == "position"
    assert VX300S.tracking.rate == pytest.approx(VX300S.alpha)
    assert 0.01 < max(VX300S.tracking.position_errors(6)) < 0.05
    assert "identify_servos" in VX300S.tracking.provenance
    assert VX300S.licence == "Apache-2.0"
    with pytest.raises(ConfigurationError, match="vx300s cannot be simulated"):
        load_mujoco_model("vx300s")
