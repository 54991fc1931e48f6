"""The cover of links that finger joints move contains them at every value of the joints, not only at sampled ones."""

import numpy as np
import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.robots.collision_model.coverage import SphereSet, are_covered
from dualbrain.robots.collision_model.polytope import convex_hull
from dualbrain.robots.collision_model.swept_volume import swept_mesh
from dualbrain.robots.importer.build_arm import ImportOptions, build_arm
from dualbrain.robots.importer.kinematic_chain import find_chain
from dualbrain.robots.importer.urdf import read_urdf
from tests.robots.importer.urdf_builder import joint_xml, limit_policy, link_xml, urdf_xml, write_file

TURN = '<limit lower="-3.1" upper="3.1" velocity="1" effort="1"/>'
SLIDE = '<limit lower="0" upper="0.6" velocity="1" effort="1"/>'
BLADE = ((0.02, 0.2, 0.02), (0, 0.1, 0.05))


def swept_tree(folder, kinds):
    """An arm of one joint, and a blade behind the swept joints of `kinds` on oblique axes."""
    axes = {"revolute": "0.3 0.2 1", "continuous": "0 -1 0.4", "prismatic": "1 0.2 0"}
    parts, parent = [], "arm"
    for i, kind in enumerate(kinds):
        child = "blade" if i == len(kinds) - 1 else f"link{i}"
        inside = {"revolute": TURN, "prismatic": SLIDE, "continuous": ""}[kind]
        parts += [f'<link name="{child}"/>'] if child != "blade" else [link_xml(child, *BLADE)]
        parts.append(joint_xml(f"f{i}", parent, child, kind, axes[kind], "0 0.02 0.05", "0.2 0.1 0", inside=inside))
        parent = child
    text = urdf_xml(link_xml("base"), link_xml("arm"), joint_xml("j", "base", "arm"), *parts)
    return read_urdf(write_file(folder, text))


def blade_at(tree, chain, rng):
    """The vertices of the blade in the last chain frame at random values of the swept joints."""
    pose = next(segment for segment in chain.segments if segment.link == "arm").poses[0]
    for joint in tree.joints:
        if joint.name != "j":
            low, high = (-np.pi, np.pi) if joint.lower is None else (joint.lower, joint.upper)
            pose = pose @ joint.child_pose(rng.uniform(low, high))
    vertices = tree.links["blade"].shapes[0].load_mesh().vertices
    return vertices @ pose[:3, :3].T + pose[:3, 3]


@pytest.mark.parametrize(
    "kinds", [("revolute",), ("continuous",), ("prismatic",), ("revolute", "prismatic"), ("continuous", "revolute")]
)
def test_one_cell_contains_the_whole_body_at_every_value(tmp_path, kinds):
    tree = swept_tree(tmp_path, kinds)
    chain = find_chain(tree, tip="arm")
    sweep = next(segment for segment in chain.segments if segment.link == "blade").sweep
    mesh = tree.links["blade"].shapes[0].load_mesh()
    hulls = [convex_hull(swept_mesh(mesh, cell[None])) for cell in sweep]
    rng = np.random.default_rng(0)
    for _ in range(40):
        points = blade_at(tree, chain, rng)
        assert max(hull.depth(points).min() for hull in hulls) > -1e-9


def test_the_spheres_cover_a_blade_that_turns_by_a_whole_turn(tmp_path):
    tree = swept_tree(tmp_path, ("revolute",))
    model = build_arm(tree, limit_policy(), ImportOptions(tip="arm", quick=True, sphere_budget=60)).robot_model
    spheres = [sphere for sphere in model.spheres if sphere.link == "fingers"]
    cover = SphereSet(np.array([one.centre for one in spheres]), np.array([one.radius for one in spheres]))
    chain, rng = find_chain(tree, tip="arm"), np.random.default_rng(0)
    assert all(are_covered(blade_at(tree, chain, rng), cover, tolerance=1e-4).all() for _ in range(200))


def test_a_sliding_part_without_a_range_is_refused_unless_it_is_locked(tmp_path):
    text = urdf_xml(
        *map(link_xml, ("base", "arm", "rod")),
        joint_xml("j", "base", "arm"),
        joint_xml("rod", "arm", "rod", "prismatic", inside='<limit velocity="1" effort="1"/>'),
    )
    tree = read_urdf(write_file(tmp_path, text))
    with pytest.raises(ConfigurationError, match=r"'rod' .*no range.*--lock rod=VALUE"):
        find_chain(tree, tip="arm")
    assert find_chain(tree, tip="arm", lock={"rod": 0.0}).locked == {"rod": 0.0}
