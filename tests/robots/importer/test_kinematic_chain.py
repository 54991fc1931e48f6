"""One serial chain out of any tree: what moves, what rides where, what stands still, and what is refused."""

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


def test_slides_turns_and_fixed_joints_become_a_chain_and_fingers_do_not(everything):
    chain = find_chain(everything)
    assert [joint.name for joint in chain.joints] == ["lift", "shoulder", "elbow"]
    assert chain.tip == "lower"
    assert {rider.link for rider in chain.segments if rider.is_swept} == {"left", "right"}
    assert not chain.locked


def test_a_swept_finger_is_where_its_joint_may_put_it(everything):
    chain = find_chain(everything)
    places = {rider.link: rider.poses[:, :3, 3] for rider in chain.segments}
    for finger, side in (("left", 1.0), ("right", -1.0)):
        across = (places[finger] - places[finger][0]) @ chain.segments[-1].poses[0][:3, 0] * side
        assert np.ptp(np.linalg.norm(places[finger] - places[finger][0], axis=1)) == pytest.approx(0.04)
        assert np.abs(across).max() == pytest.approx(0.04)


def test_the_tool_may_be_any_link_fixed_to_the_last(everything):
    plain, flange = find_chain(everything), find_chain(everything, tip="lower", tool="flange")
    assert np.linalg.norm(flange.tool[:3, 3] - plain.tool[:3, 3]) == pytest.approx(0.22)
    with pytest.raises(ConfigurationError, match="a link fixed to the last joint"):
        find_chain(everything, tip="lower", tool="column")
    with pytest.raises(UnknownNameError, match="Closest: 'flange'"):
        find_chain(everything, tool="flang")


def test_a_locked_joint_is_no_joint_of_the_body_but_moves_what_hangs_on_it(everything):
    low, high = (find_chain(everything, lock={"lift": value}) for value in (0.0, 0.3))
    assert [joint.name for joint in high.joints] == ["shoulder", "elbow"]
    assert high.offsets[0][2, 3] - low.offsets[0][2, 3] == pytest.approx(0.3)
    assert np.allclose(high.offsets[1], low.offsets[1])


def test_several_arms_are_listed_with_the_words_to_choose_one(tmp_path):
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
    assert {rider.link for rider in chain.segments if rider.frame == 0} == {"base", *(f"right{i}" for i in range(4))}


@pytest.mark.parametrize(
    ("kind", "inside", "said"),
    [
        ("floating", "", "--chain a.."),
        ("planar", "", "--base"),
        ("revolute", '<limit lower="-1" upper="1" velocity="1"/><mimic joint="other"/>', "--lock wrist=VALUE"),
    ],
)
def test_a_joint_that_one_control_cannot_drive_is_refused_with_a_way_out(tmp_path, kind, inside, said):
    text = urdf_xml(
        link_xml("base"),
        link_xml("a"),
        link_xml("b"),
        joint_xml("wrist", "base", "a", kind, inside=inside),
        joint_xml("other", "a", "b"),
    )
    with pytest.raises(ConfigurationError, match="wrist") as caught:
        find_chain(read_urdf(write_file(tmp_path, text)), tip="b")
    assert said in str(caught.value)
    assert "robot.urdf:6" in str(caught.value)


def test_a_planar_joint_before_the_chain_stands_still_and_is_told(tmp_path):
    text = urdf_xml(
        link_xml("floor"),
        link_xml("base"),
        link_xml("a"),
        joint_xml("drive", "floor", "base", "planar", inside=""),
        joint_xml("turn", "base", "a"),
    )
    chain = find_chain(read_urdf(write_file(tmp_path, text)), base="base", tip="a")
    assert "drive" in chain.locked


def test_more_joints_than_the_kernel_has_are_refused(tmp_path):
    with pytest.raises(ConfigurationError, match=r"got 17, allowed: at most 16.*--lock"):
        build_arm(read_urdf(write_file(tmp_path, snake(17))), limit_policy(), ImportOptions())


def snake(n):
    """A chain of `n` joints whose axes take turns."""
    names = [f"l{i}" for i in range(n + 1)]
    turns = [joint_xml(f"j{b}", a, b, axis="0 1 0" if i % 2 else "0 0 1") for i, (a, b) in enumerate(pairwise(names))]
    return urdf_xml(*(link_xml(name, (0.04, 0.04, 0.1), (0, 0, 0.1)) for name in names), *turns)


@pytest.mark.parametrize("n", [8, 9, 14])
def test_arms_of_many_joints_are_made_and_filtered(tmp_path, n):
    """The kernel's build is chosen by the body; the tool against a walk through the tree."""
    tree = read_urdf(write_file(tmp_path, snake(n)))
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


def test_the_body_moves_as_the_tree_says(everything):
    """The kernel's tool against a walk through the tree, joint by joint."""
    made = build_arm(everything, limit_policy(), ImportOptions(quick=True, sphere_budget=40))
    safety = SafetyFilter(made.robot_model)
    rng = np.random.default_rng(1)
    for _ in range(20):
        q = dict(zip(("lift", "shoulder", "elbow"), rng.uniform(0.0, 0.5, 3), strict=True))
        poses, _ = link_poses_at_rest(everything, "base", q)
        tool = safety.tool(np.array(list(q.values())))
        assert np.allclose(tool.position, poses["lower"][:3, 3], atol=2e-6)
        assert np.allclose(tool.rotation, poses["lower"][:3, :3], atol=2e-6)
    assert made.robot_model.name == "test_arm_7"
    assert made.report.coverage == 1.0
    groups = {sphere.link for sphere in made.robot_model.spheres}
    assert {"base", "hand", "fingers"} <= groups


def test_names_become_identifiers():
    assert [to_identifier(name) for name in ("UR5", "2-link Arm", "", "A" * 50)] == [
        "ur5",
        "robot_2_link_arm",
        "robot",
        "a" * 32,
    ]


def test_the_room_is_the_kernels():
    room = (_kernel_wide.max_joints, _kernel_wide.max_spheres, _kernel_wide.max_links, _kernel_wide.max_pairs)
    assert room == (MAX_JOINTS, MAX_SPHERES, MAX_LINKS, MAX_PAIRS)
