"""Extraction of one serial chain from a tree: its joints, the frames of all links, fixed joints, and refusals."""

from itertools import pairwise

import numpy as np
import pytest

from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.importer.build_arm import (
    MAX_JOINTS,
    MAX_LINKS,
    MAX_PAIRS,
    MAX_SPHERES,
    ImportOptions,
    build_arm,
    rigid_parts,
    to_identifier,
)
from dualbrain.robots.importer.kinematic_chain import find_chain, link_poses_at_rest
from dualbrain.robots.importer.urdf import read_urdf
from dualbrain.safety.cbf.compiled import _kernel_wide
from dualbrain.safety.cbf.filter import SafetyFilter
from tests.robots.importer.urdf_builder import (
    full_featured_arm,
    joint_xml,
    limit_policy,
    link_xml,
    urdf_xml,
    write_file,
)


@pytest.fixture(scope="module")
def everything(tmp_path_factory):
    return read_urdf(write_file(tmp_path_factory.mktemp("arm"), full_featured_arm()))


def test_the_chain_contains_the_joints_of_the_arm_and_not_the_fingers(everything):
    chain = find_chain(everything)
    assert [joint.name for joint in chain.joints] == ["lift", "shoulder", "elbow"]
    assert chain.tip == "lower"
    assert {segment.link for segment in chain.segments if segment.is_swept} == {"left", "right"}
    assert not chain.locked


def test_a_swept_finger_covers_the_range_of_its_joint(everything):
    chain = find_chain(everything)
    positions = {segment.link: segment.poses[:, :3, 3] for segment in chain.segments}
    for finger, side in (("left", 1.0), ("right", -1.0)):
        across = (positions[finger] - positions[finger][0]) @ chain.segments[-1].poses[0][:3, 0] * side
        assert np.ptp(np.linalg.norm(positions[finger] - positions[finger][0], axis=1)) == pytest.approx(0.04)
        assert np.abs(across).max() == pytest.approx(0.04)


def test_the_tool_may_be_any_link_fixed_to_the_last(everything):
    plain, flange = find_chain(everything), find_chain(everything, tip="lower", tool="flange")
    assert np.linalg.norm(flange.tool[:3, 3] - plain.tool[:3, 3]) == pytest.approx(0.22)
    with pytest.raises(ConfigurationError, match="a link fixed to the last joint"):
        find_chain(everything, tip="lower", tool="column")
    with pytest.raises(UnknownNameError, match="Closest: 'flange'"):
        find_chain(everything, tool="flang")


def test_a_locked_joint_is_not_in_the_model_but_moves_the_links_behind_it(everything):
    low, high = (find_chain(everything, lock={"lift": value}) for value in (0.0, 0.3))
    assert [joint.name for joint in high.joints] == ["shoulder", "elbow"]
    assert high.offsets[0][2, 3] - low.offsets[0][2, 3] == pytest.approx(0.3)
    assert np.allclose(high.offsets[1], low.offsets[1])


def test_several_arms_are_listed_with_the_options_to_choose_one(tmp_path):
    parts = [link_xml("base")]
    for side in ("left", "right"):
        names = ["base", *(f"{side}{i}" for i in range(4))]
        parts += [link_xml(name) for name in names[1:]]
        parts += [joint_xml(f"{b}_joint", a, b) for a, b in pairwise(names)]
    tree = read_urdf(write_file(tmp_path, urdf_xml(*parts)))
    with pytest.raises(ConfigurationError, match=r"--chain base\.\.left3 or --chain base\.\.right3"):
        find_chain(tree)
    chain = find_chain(tree, tip="left3")
    assert chain.locked == {f"right{i}_joint": 0.0 for i in range(4)}
    fixed = {segment.link for segment in chain.segments if segment.frame == 0}
    assert fixed == {"base", *(f"right{i}" for i in range(4))}


@pytest.mark.parametrize(
    ("kind", "inside", "message"),
    [
        ("floating", "", "--chain a.."),
        ("planar", "", "--base"),
        ("revolute", '<limit lower="-1" upper="1" velocity="1"/><mimic joint="other"/>', "--lock wrist=VALUE"),
    ],
)
def test_a_joint_that_one_control_cannot_drive_is_refused_with_a_fix(tmp_path, kind, inside, message):
    text = urdf_xml(
        link_xml("base"),
        link_xml("a"),
        link_xml("b"),
        joint_xml("wrist", "base", "a", kind, inside=inside),
        joint_xml("other", "a", "b"),
    )
    with pytest.raises(ConfigurationError, match="wrist") as caught:
        find_chain(read_urdf(write_file(tmp_path, text)), tip="b")
    assert message in str(caught.value)
    assert "robot.urdf:6" in str(caught.value)


def test_a_planar_joint_before_the_chain_is_locked_and_reported(tmp_path):
    text = urdf_xml(
        link_xml("floor"),
        link_xml("base"),
        link_xml("a"),
        joint_xml("drive", "floor", "base", "planar", inside=""),
        joint_xml("turn", "base", "a"),
    )
    chain = find_chain(read_urdf(write_file(tmp_path, text)), base="base", tip="a")
    assert "drive" in chain.locked


def test_more_joints_than_the_kernel_supports_are_refused(tmp_path):
    with pytest.raises(ConfigurationError, match=r"got 17, allowed: at most 16.*--lock"):
        build_arm(read_urdf(write_file(tmp_path, chain_of(17))), limit_policy(), ImportOptions())


def chain_of(n):
    """A chain of `n` joints with alternating axes."""
    names = [f"l{i}" for i in range(n + 1)]
    joints = [joint_xml(f"j{b}", a, b, axis="0 1 0" if i % 2 else "0 0 1") for i, (a, b) in enumerate(pairwise(names))]
    return urdf_xml(*(link_xml(name, (0.04, 0.04, 0.1), (0, 0, 0.1)) for name in names), *joints)


@pytest.mark.parametrize("n", [8, 9, 14])
def test_arms_of_many_joints_are_built_and_filtered(tmp_path, n):
    """The number of joints selects the build of the kernel, whose tool frame agrees with a walk through the tree."""
    tree = read_urdf(write_file(tmp_path, chain_of(n)))
    robot_model = build_arm(
        tree, limit_policy(), ImportOptions(quick=True, sphere_budget=30, home=tuple([0.1] * n))
    ).robot_model
    safety = SafetyFilter(robot_model)
    q = np.random.default_rng(n).uniform(-0.5, 0.5, n)
    poses, _ = link_poses_at_rest(
        tree, "l0", {joint.name: value for joint, value in zip(robot_model.joints, q, strict=True)}
    )
    tool = safety.tool(q)
    assert np.allclose(tool.position, poses[f"l{n}"][:3, 3], atol=3e-6)
    assert np.allclose(tool.rotation, poses[f"l{n}"][:3, :3], atol=3e-6)
    answer = safety(np.array(robot_model.home), np.zeros(n), np.ones(n))
    assert answer.certified
    assert answer.u.shape == (n,)


def test_the_model_moves_like_the_tree(everything):
    """The tool frame of the kernel agrees with a walk through the tree, joint by joint."""
    result = build_arm(everything, limit_policy(), ImportOptions(quick=True, sphere_budget=40))
    safety = SafetyFilter(result.robot_model)
    rng = np.random.default_rng(1)
    for _ in range(20):
        q = dict(zip(("lift", "shoulder", "elbow"), rng.uniform(0.0, 0.5, 3), strict=True))
        poses, _ = link_poses_at_rest(everything, "base", q)
        tool = safety.tool(np.array(list(q.values())))
        assert np.allclose(tool.position, poses["lower"][:3, 3], atol=2e-6)
        assert np.allclose(tool.rotation, poses["lower"][:3, :3], atol=2e-6)
    assert result.robot_model.name == "test_arm_7"
    assert result.report.coverage == 1.0
    links = {sphere.link for sphere in result.robot_model.spheres}
    assert {"base", "hand", "fingers"} <= links


LIFT = '<limit lower="0" upper="0.5" velocity="1" effort="9"/>'


def two_stage_lift(rule):
    return urdf_xml(
        *map(link_xml, ("base", "stage", "plate", "arm")),
        joint_xml("lift", "base", "stage", "prismatic", "0 0 1", inside=LIFT),
        joint_xml("lift2", "stage", "plate", "prismatic", "0 0 1", inside=LIFT + f'<mimic joint="lift" {rule}/>'),
        joint_xml("j", "base", "arm"),
    )


@pytest.mark.parametrize(
    ("rule", "lock", "follower"),
    [
        ("", {"lift": 0.3}, 0.3),
        ('multiplier="0.5" offset="0.1"', {"lift": 0.3}, 0.25),
        ('offset="0.1"', {}, 0.1),
        ("", {"lift": 0.3, "lift2": 0.2}, 0.2),
    ],
)
def test_a_fixed_joint_that_follows_another_one_is_where_its_leader_puts_it(tmp_path, rule, lock, follower):
    tree = read_urdf(write_file(tmp_path, two_stage_lift(rule)))
    assert find_chain(tree, tip="arm", lock=lock).locked["lift2"] == pytest.approx(follower)
    poses, values = link_poses_at_rest(tree, "base", lock)
    assert values["lift2"] == pytest.approx(follower)
    assert poses["plate"][2, 3] == pytest.approx(0.4 + lock.get("lift", 0.0) + follower)


def test_a_link_outside_the_chain_that_moves_with_it_is_refused_unless_it_is_locked(tmp_path):
    """The rod of a parallelogram."""
    text = urdf_xml(
        *map(link_xml, ("base", "upper", "fore", "rod")),
        joint_xml("shoulder", "base", "upper"),
        joint_xml("elbow", "upper", "fore"),
        joint_xml("side", "base", "rod", xyz="0.2 0 0.2", inside=LIFT + '<mimic joint="shoulder"/>'),
    )
    tree = read_urdf(write_file(tmp_path, text))
    with pytest.raises(ConfigurationError, match=r"'side' .*follows 'shoulder'.*--lock side=VALUE"):
        find_chain(tree, tip="fore")
    assert find_chain(tree, tip="fore", lock={"side": 0.1}).locked == {"side": 0.1}


@pytest.mark.parametrize(("position", "name"), [(0, "hand"), (1, "hand"), (1, "fingers"), (2, "hand"), (1, "held")])
def test_a_link_with_the_name_of_a_group_keeps_its_frame_and_its_shapes(tmp_path, position, name):
    """Its shapes are not joined with those of the hand, and a permit for the group does not hold for it."""
    names = ["a", "b", "c"]
    names[position] = name
    text = urdf_xml(
        *map(link_xml, names),
        link_xml("tip", (0.3, 0.05, 0.05)),
        joint_xml("one", names[0], names[1]),
        joint_xml("two", names[1], names[2]),
        joint_xml("weld", names[2], "tip", "fixed", inside=""),
    )
    tree = read_urdf(write_file(tmp_path, text))
    links, shapes = rigid_parts(tree, find_chain(tree))
    names[position] = f"{name}_link"
    assert [(link.name, link.frame, link.group) for link in links] == [
        (names[0], 0, "base"),
        (names[1], 1, "arm"),
        (names[2], 2, "arm"),
        ("hand", 2, "hand"),
    ]
    assert {name: len(meshes) for name, meshes in shapes.items()} == dict.fromkeys([*names, "hand"], 1)


def test_names_become_identifiers():
    assert [to_identifier(name) for name in ("UR5", "2-link Arm", "", "A" * 50)] == [
        "ur5",
        "robot_2_link_arm",
        "robot",
        "a" * 32,
    ]


def test_the_limits_of_the_importer_are_those_of_the_kernel():
    limits = (_kernel_wide.max_joints, _kernel_wide.max_spheres, _kernel_wide.max_links, _kernel_wide.max_pairs)
    assert limits == (MAX_JOINTS, MAX_SPHERES, MAX_LINKS, MAX_PAIRS)
