"""Input of the kernel for robot models, configurations and obstacles: every number in its documented place."""

import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace, Pose, Sphere
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.safety.cbf import kernel
from dualbrain.safety.cbf.compiled import _kernel
from dualbrain.safety.cbf.filter import FilterConfig, Obstacle
from dualbrain.safety.cbf.kernel import kernel_model, max_gain, obstacle_table, tool_frame, tracking_errors
from dualbrain.safety.cbf.obstacles import SpeedAndSeparation
from dualbrain.safety.cbf.rows import Rank
from tests.safety import geometry_oracle

POSE = Pose((0.1, -0.2, 0.3), (0.5, 0.5, -0.5, 0.5))
SHAPES = {
    "sphere": (Sphere(0.07), 0.0, (0.0, 0.0, 0.0), 0.07),
    "capsule": (Capsule(0.05, 0.2), 0.0, (0.0, 0.0, 0.2), 0.05),
    "box": (Box((0.1, 0.2, 0.3)), 1.0, (0.1, 0.2, 0.3), 0.0),
    "half-space": (HalfSpace(), 2.0, (0.0, 0.0, 0.0), 0.0),
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("known", "static"), [(False, False), (True, False), (False, True), (True, True)])
def test_an_obstacle_is_one_row_with_zeros_for_missing_dimensions(shape, known, static):
    solid, kind, half, radius = SHAPES[shape]
    obstacle = Obstacle(
        "x",
        solid,
        POSE,
        velocity=(0.4, 0.5, 0.6),
        margin=0.01,
        known=known,
        static=static,
        velocity_error=0.02,
        alpha=1.5,
        rank=Rank.WORKSPACE,
        parts=("hand", "link3"),
        separation=SpeedAndSeparation(0.1, 0.9, 0.3),
    )
    expected = [
        kind,
        known + 2.0 * static,
        3.0,
        2.0**4 + 2.0**6 + 2.0**9,
        1.5,
        *POSE.position,
        *geometry_oracle.rotation_matrix(POSE.quaternion).ravel(),
        *half,
        radius,
        0.4,
        0.5,
        0.6,
        0.01,
        0.02,
        0.1,
        0.9,
        0.3,
    ]
    table = obstacle_table([obstacle, obstacle], {"hand": (4, 6), "link3": (9,), "other": (1,)})
    assert table.shape == (2, 29)
    np.testing.assert_allclose(table, [expected, expected], atol=1e-15)


def test_an_obstacle_without_options_applies_to_every_part():
    row = obstacle_table([Obstacle("x", Sphere(0.1), POSE)])[0]
    assert row[3] == 2.0**32 - 1.0
    assert row[4] == 0.0
    assert row[26:].tolist() == [0.0, 0.0, 0.0]
    assert obstacle_table([]).shape == (0, 29)


def test_the_table_holds_512_obstacles():
    one = Obstacle("x", Sphere(0.1), POSE)
    assert len(obstacle_table([one] * 512)) == 512 == _kernel.max_obstacles == kernel.MAX_OBSTACLES
    with pytest.raises(ConfigurationError, match="obstacles at once") as values:
        obstacle_table([one] * 513)
    assert (values.value.got, values.value.allowed) == (513, "at most 512")
    with pytest.raises(UnknownNameError, match="elbow"):
        obstacle_table([msgspec.structs.replace(one, parts=("elbow",))], {"hand": (1,)})


def test_settings_are_those_of_the_configuration(panda):
    config = FilterConfig(
        alpha=1.1,
        alpha_self=1.2,
        alpha_joint=1.3,
        recovery_speed=0.07,
        sampling_margin=3e-4,
        rounding_margin=2e-5,
        self_margin=0.004,
        tracking_error=0.006,
        scene_stale_after=0.4,
        state_stale_after=0.03,
    )
    values = kernel_model(panda, config)
    expected = {
        "n": 7,
        "period": panda.period,
        "alpha": 1.1,
        "alpha_self": 1.2,
        "alpha_joint": 1.3,
        "recovery": 0.07,
        "sampling": 3e-4,
        "rounding": 2e-5,
        "self_margin": 0.004,
        "lag": panda.tracking.lag,
        "state_age_max": 0.03,
        "scene_age_max": 0.4,
    }
    assert {name: values[name] for name in expected} == expected
    assert values["tracking"].tolist() == [0.006] * 7
    assert panda.tracking.lag > 0.0


def test_gains_fall_back_on_the_filter_and_then_on_the_robot_model(panda):
    names = ("alpha", "alpha_self", "alpha_joint")
    gains = [joint.acceleration.value / joint.velocity.value for joint in panda.joints]
    assert panda.alpha == pytest.approx(min(gains))
    for config, expected in (
        (FilterConfig(), [panda.alpha] * 3),
        (FilterConfig(alpha=1.7), [1.7] * 3),
        (FilterConfig(alpha=1.7, alpha_self=2.1), [1.7, 2.1, 1.7]),
        (FilterConfig(alpha_joint=0.2), [panda.alpha, panda.alpha, 0.2]),
    ):
        values = kernel_model(panda, config)
        assert [values[name] for name in names] == expected
        assert max_gain(panda, config) == max(expected)
        margins = panda.tracking.row_margins(max(expected), 7)
        assert tuple(tracking_errors(panda, config)) == tuple(values["tracking"]) == margins
    assert not tracking_errors(panda, FilterConfig(tracking_error=0.0)).any()
    each = tuple(float(k) / 100.0 for k in range(7))
    assert tuple(tracking_errors(panda, FilterConfig(tracking_error=each))) == each
    with pytest.raises(ConfigurationError, match=r"'6 numbers', allowed: one number, or 7 for the joints of panda"):
        kernel_model(panda, FilterConfig(tracking_error=each[:6]))
    assert kernel_model(panda, FilterConfig(lag_compensation=False))["lag"] == 0.0


def test_limits_are_those_of_the_robot_model_or_never_bind(panda):
    values = kernel_model(panda, FilterConfig(jerk_limits=True))
    for name, limit in (
        ("q_lower", "lower"),
        ("q_upper", "upper"),
        ("v_max", "velocity"),
        ("a_max", "acceleration"),
        ("j_max", "jerk"),
    ):
        assert values[name].tolist() == [getattr(joint, limit).value for joint in panda.joints]
    free = kernel_model(panda, FilterConfig(acceleration_limits=False))
    assert np.all(free["a_max"] * panda.period >= 2.0 * free["v_max"])
    assert free["a_max"].tolist() == [kernel.UNLIMITED_ACCELERATION] * 7 == [1e4] * 7
    assert not free["j_max"].any()


def test_the_weight_is_the_inverse_square_of_the_velocity_limits_or_as_given(panda):
    v = np.array([joint.velocity.value for joint in panda.joints])
    M = np.random.default_rng(1).normal(size=(7, 7))
    for weight, R in ((None, np.diag(v**-2.0)), (M @ M.T, M @ M.T)):
        S = kernel_model(panda, FilterConfig(), weight)["scale"]
        np.testing.assert_allclose(S.T @ R @ S, np.eye(7), atol=1e-6)
        np.testing.assert_allclose(np.triu(S), S, atol=1e-12)
    for wrong in (-np.eye(7), np.zeros((7, 7))):
        with pytest.raises(ConfigurationError, match="weight R") as values:
            kernel_model(panda, FilterConfig(), wrong)
        assert values.value.got == wrong.tolist()


def test_the_geometry_is_that_of_the_robot_model_in_joint_frames(panda):
    values = kernel_model(panda, FilterConfig())
    assert values["joint_kind"].tolist() == [0.0] * 7
    assert values["link_frame"].tolist() == [link.frame for link in panda.links]
    counts = [sum(sphere.link == link.name for sphere in panda.spheres) for link in panda.links]
    assert values["link_first"].tolist() == [0, *np.cumsum(counts)]
    for k, joint in enumerate(panda.joints):
        np.testing.assert_allclose(
            values["joint_rotation"][9 * k : 9 * k + 9],
            geometry_oracle.rotation_matrix(joint.quaternion).ravel(),
            atol=1e-12,
        )
        assert values["joint_offset"][3 * k : 3 * k + 3].tolist() == list(joint.translation)
    at = 0
    for link in panda.links:
        R, p = geometry_oracle.rotation_matrix(link.quaternion), np.array(link.translation)
        for sphere in (sphere for sphere in panda.spheres if sphere.link == link.name):
            expected = [*(p + R @ np.array(sphere.centre)), sphere.radius, *(R @ np.array(link.slide))]
            np.testing.assert_allclose(values["spheres"][at], expected, atol=1e-12)
            at += 1
    assert at == len(values["spheres"])
    sliding = msgspec.structs.replace(
        panda, joints=(msgspec.structs.replace(panda.joints[0], kind="prismatic"), *panda.joints[1:])
    )
    assert kernel_model(sliding, FilterConfig())["joint_kind"].tolist() == [1.0, *[0.0] * 6]


def test_the_tool_frame_follows_from_its_link(panda):
    link = next(link for link in panda.links if link.name == panda.tool.link)
    turn, offset = tool_frame(panda)
    R = geometry_oracle.rotation_matrix(link.quaternion)
    np.testing.assert_allclose(turn, R @ geometry_oracle.rotation_matrix(panda.tool.quaternion), atol=1e-12)
    np.testing.assert_allclose(offset, np.array(link.translation) + R @ np.array(panda.tool.translation), atol=1e-12)
    values = kernel_model(panda, FilterConfig())
    np.testing.assert_allclose(values["tool_rotation"], turn)
    np.testing.assert_allclose(values["tool_offset"], offset)
    early = msgspec.structs.replace(panda, tool=msgspec.structs.replace(panda.tool, link=panda.links[1].name))
    with pytest.raises(ConfigurationError, match="link of the tool") as values:
        tool_frame(early)
    assert values.value.got == panda.links[1].name
    assert "(7)" in values.value.allowed


def test_pairs_have_the_nearer_link_first_and_grasped_objects_keep_away_like_the_hand(panda):
    values = kernel_model(panda, FilterConfig())
    names = [link.name for link in panda.links]
    pairs = values["pairs"].astype(int).reshape(-1, 2)
    frames = values["link_frame"]
    assert {frozenset((names[a], names[b])) for a, b in pairs} == {frozenset(pair) for pair in panda.self_pairs.kept}
    assert all(frames[a] < frames[b] for a, b in pairs)
    hand = {a for a, b in pairs if panda.links[b].group in ("hand", "fingers")}
    assert values["held_links"].tolist() == sorted(hand)
    assert hand
    swapped = tuple((b, a) for a, b in panda.self_pairs.kept)
    turned = msgspec.structs.replace(panda, self_pairs=msgspec.structs.replace(panda.self_pairs, kept=swapped))
    assert np.array_equal(kernel_model(turned, FilterConfig())["pairs"], values["pairs"])
    fixed = [link.name for link in panda.links if link.frame == 7][:2]
    stiff = msgspec.structs.replace(panda, self_pairs=msgspec.structs.replace(panda.self_pairs, kept=(tuple(fixed),)))
    with pytest.raises(ConfigurationError, match="self-collision pair"):
        kernel_model(stiff, FilterConfig())


def test_an_exceeded_capacity_is_reported_with_its_number(panda, monkeypatch):
    """An exceeded capacity is rejected by name, with the number of the largest available build."""
    monkeypatch.setattr(kernel, "BUILD_SUFFIXES", ("",))
    assert kernel.select_build(panda, FilterConfig()) is _kernel
    for what, change in (("spheres", {"spheres": panda.spheres * 3}), ("parts", {"links": panda.links * 4})):
        many = msgspec.structs.replace(panda, **change)
        with pytest.raises(ConfigurationError, match=what) as values:
            kernel.select_build(many, FilterConfig())
        assert values.value.got == len(next(iter(change.values())))
    assert kernel.kernel_hash() == _kernel.source_hash
    assert len(kernel.kernel_hash()) == 16
    assert quaternion_to_matrix(POSE.quaternion) == pytest.approx(geometry_oracle.rotation_matrix(POSE.quaternion))
