"""Kinematics against MuJoCo; sine and cosine against the standard library."""

import math

import mujoco
import numpy as np
import pytest

from dualbrain.robots.differential_drive import integrate_configuration
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.compiled import _kernel, _kernel64
from dualbrain.safety.cbf.filter import FilterConfig, SafetyFilter
from tests.safety import geometry_oracle, mujoco_oracle


@pytest.mark.parametrize(("kernel", "tolerance"), [(_kernel, 2.5e-7), (_kernel64, 3e-16)])
def test_sine_and_cosine_are_accurate_to_the_last_place(kernel, tolerance, rng):
    for x in [*rng.uniform(-7.0, 7.0, 2000), 0.0, math.pi / 4, -math.pi / 2, math.pi]:
        rounded = float(np.float32(x)) if kernel is _kernel else float(x)
        sine, cosine = kernel.sincos(rounded)
        assert abs(sine - math.sin(rounded)) <= tolerance
        assert abs(cosine - math.cos(rounded)) <= tolerance


@pytest.mark.parametrize(("real", "tolerance"), [("float32", 2e-6), ("float64", 1e-12)])
def test_tool_and_jacobian_agree_with_mujoco(panda, rng, random_posture, real, tolerance):
    safety = SafetyFilter(panda, FilterConfig(precision=real))
    model = mujoco.MjModel.from_xml_string(mujoco_oracle.build_mjcf(panda))
    data = mujoco.MjData(model)
    site = model.site("tool").id
    for _ in range(50):
        q = random_posture(rng)
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        linear, angular = np.empty((3, 7)), np.empty((3, 7))
        mujoco.mj_jacSite(model, data, linear, angular, site)
        tool = safety.tool(q)
        np.testing.assert_allclose(tool.position, data.site_xpos[site], atol=tolerance)
        np.testing.assert_allclose(tool.rotation, data.site_xmat[site].reshape(3, 3), atol=tolerance)
        np.testing.assert_allclose(tool.jacobian, np.vstack([linear, angular]), atol=2 * tolerance)


@pytest.mark.parametrize("opening", [0.0, 0.025, 0.04])
def test_spheres_move_with_their_links_and_fingers(panda, rng, random_posture, opening):
    safety = SafetyFilter(panda, FilterConfig(precision="float64"))
    model = mujoco.MjModel.from_xml_string(mujoco_oracle.build_mjcf(panda))
    data = mujoco.MjData(model)
    for _ in range(10):
        q = random_posture(rng)
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        centres, radii, groups = safety.spheres(q, opening)
        for k, name in enumerate(mujoco_oracle.sphere_names(panda)):
            link = next(x for x in panda.links if x.name == name.split(".")[0])
            slide = data.xmat[model.body(link.name).id].reshape(3, 3) @ np.array(link.slide)
            geom = model.geom(name).id
            np.testing.assert_allclose(centres[k], data.geom_xpos[geom] + opening * slide, atol=1e-9)
            assert radii[k] == pytest.approx(model.geom_size[geom][0], abs=1e-9)
            assert groups[k] == link.group


def moved_centres(body, q):
    """Centres (k, 3) [m] of a mobile robot's spheres in the world at q = (x, y, heading, ...), gripper at 40 mm."""
    centres, _, _ = geometry_oracle.sphere_centres(body, np.concatenate([np.zeros(2), q[3:]])[None], opening=0.04)
    c, s = math.cos(q[2]), math.sin(q[2])
    return centres[0] @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + np.array([q[0], q[1], 0.0])


@pytest.mark.parametrize("name", ["base", "mobile_panda"])
def test_the_accelerations_of_a_base_are_those_of_its_arc(name, rng, state_at):
    body = load_robot(name)
    safety = SafetyFilter(body, FilterConfig(precision="float64", lag_compensation=False, tracking_error=0.0))
    fastest = np.array([joint.velocity.value for joint in body.joints])
    for _ in range(5):
        q, u = np.array(body.home, float), rng.uniform(-0.8, 0.8, body.n) * fastest
        q[:3] = 0.0
        safety.reset(u)
        safety.filter(state_at(q, u, 0.0), u, 0.0)
        middle = 0.5 * np.sum([np.array(side) for side in safety._kernel.box()], axis=0)
        motion = safety._kernel.debug_readout(0.0, False)["motion"]
        count = len(body.spheres)
        got = np.stack([np.frombuffer(motion[f"a{axis}"])[:count] for axis in "xyz"], axis=1)
        step = 5e-4
        ahead, behind = (moved_centres(body, integrate_configuration(q, middle, sign * step)) for sign in (1.0, -1.0))
        expected = (ahead - 2.0 * moved_centres(body, q) + behind) / step**2
        assert abs(middle[0] * middle[1]) > 1e-3
        chord = 0.5 * body.period * abs(middle[0]) * middle[1] ** 2  # the drive axis is the chord of one period
        np.testing.assert_allclose(got, expected, atol=chord + 2e-6)


def test_held_spheres_follow_the_tool(panda, rng, random_posture):
    safety = SafetyFilter(panda, FilterConfig(precision="float64"))
    held = np.array([[0.0, 0.01, 0.02, 0.03], [0.0, 0.0, 0.05, 0.02]])
    safety.attach(held, 0.0)
    q = random_posture(rng)
    tool = safety.tool(q)
    centres, radii, groups = safety.spheres(q, 0.01)
    np.testing.assert_allclose(centres[-2:], tool.position + held[:, :3] @ tool.rotation.T, atol=1e-12)
    np.testing.assert_allclose(radii[-2:], held[:, 3])
    assert groups[-2:] == ("held", "held")
    safety.detach()
    assert len(safety.spheres(q, 0.01)[0]) == len(panda.spheres)


def test_the_numpy_oracle_agrees_with_mujoco(panda, rng, random_posture):
    model = mujoco.MjModel.from_xml_string(mujoco_oracle.build_mjcf(panda))
    data = mujoco.MjData(model)
    q = np.array([random_posture(rng) for _ in range(5)])
    centres, _, _ = geometry_oracle.sphere_centres(panda, q)
    for t in range(5):
        data.qpos[:] = q[t]
        mujoco.mj_forward(model, data)
        for k, name in enumerate(mujoco_oracle.sphere_names(panda)):
            np.testing.assert_allclose(centres[t, k], data.geom_xpos[model.geom(name).id], atol=1e-9)


def test_the_damped_motion_is_the_least_squares_solution(panda, rng, random_posture):
    safety = SafetyFilter(panda)
    for damping in (1e-6, 1e-4, 1e-2):
        J = safety.tool(random_posture(rng)).jacobian
        task, free = rng.normal(size=6), rng.normal(size=7)
        u = safety.damped_least_squares(J, damping, task, free)
        stacked = np.vstack([J, math.sqrt(damping) * np.eye(7)])
        expected, *_ = np.linalg.lstsq(stacked, np.concatenate([task - J @ free, np.zeros(7)]), rcond=None)
        np.testing.assert_allclose(u - free, expected, atol=1e-7 * max(1.0, np.abs(expected).max()))


def test_a_singular_jacobian_gives_a_finite_motion_and_nan_gives_nan(panda, rng):
    safety = SafetyFilter(panda)
    task, free = rng.normal(size=6), rng.normal(size=7)
    assert np.array_equal(safety.damped_least_squares(np.zeros((6, 7)), 1e-4, task, free), free)
    assert np.isnan(safety.damped_least_squares(np.full((6, 7), np.nan), 1e-4, task, free)).all()
    with pytest.raises(ValueError, match="jacobian"):
        safety.damped_least_squares(np.zeros((6, 6)), 1e-4, task, free)
