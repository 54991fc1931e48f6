"""Every attack by an untrusted file is refused with a clear message, before any other file is read."""

import time

import numpy as np
import pytest

from dualbrain.cli.robot.read_description import read_description
from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.robots.assets import safe_xml
from dualbrain.robots.assets.mesh_paths import allowed_folders
from dualbrain.robots.importer.kinematic_tree import KinematicTree, Mimic, TreeJoint, TreeLink
from dualbrain.robots.importer.urdf import read_urdf
from dualbrain.simulation.models.mjcf_reader import read_mjcf
from tests.robots.importer.urdf_builder import joint_xml, link_xml, urdf_xml, write_file

MESH = '<link name="a"><collision><geometry><mesh filename="{}"/></geometry></collision></link>'
LAUGHS = (
    '<?xml version="1.0"?><!DOCTYPE robot [<!ENTITY a "ha">'
    + "".join(f'<!ENTITY {n} "{f"&{p};" * 10}">' for p, n in zip("abcdefgh", "bcdefghi", strict=True))
    + ']><robot name="&i;"><link name="a"/></robot>'
)
OUTSIDE = '<?xml version="1.0"?><!DOCTYPE robot [<!ENTITY x SYSTEM "file:///etc/passwd">]><robot name="&x;"/>'


@pytest.mark.parametrize("text", [LAUGHS, OUTSIDE], ids=["expansion", "external"])
def test_a_document_type_is_refused_without_expansion(tmp_path, text):
    start = time.process_time()
    with pytest.raises(ConfigurationError, match="document type"):
        read_urdf(write_file(tmp_path, text))
    assert time.process_time() - start < 2.0


@pytest.mark.parametrize(
    "name",
    [
        "../../secret.stl",
        "/etc/secret.stl",
        "file:///etc/secret.stl",
        "http://example.org/a.stl",
        "package://../a.stl",
        "package://pkg/../../secret.stl",
    ],
)
def test_no_mesh_outside_the_folder_is_read(tmp_path, name):
    (tmp_path / "secret.stl").write_text("solid")
    (tmp_path / "up" / "pkg").mkdir(parents=True)
    tree = read_urdf(write_file(tmp_path / "up" / "pkg", urdf_xml(MESH.format(name))))
    with pytest.raises((ConfigurationError, MissingDependencyError)) as caught:
        tree.links["a"].shapes[0].load_mesh()
    assert name in str(caught.value)
    assert "robot.urdf:3" in str(caught.value)


def test_a_robot_copied_out_of_a_package_finds_only_its_own_meshes(tmp_path):
    file = write_file(tmp_path / "arm" / "urdf", urdf_xml(MESH.format("x.stl")))
    (tmp_path / "arm" / "meshes").mkdir()
    for name in ("arm/meshes/a.stl", "secret.stl"):
        (tmp_path / name).write_text("solid")
    folders = allowed_folders(file)
    assert folders.find("package://many/robots/arm/meshes/a.stl", "here") == tmp_path / "arm" / "meshes" / "a.stl"
    with pytest.raises(ConfigurationError, match="a file inside"):
        folders.find("package://many/robots/arm/../secret.stl", "here")
    with pytest.raises(MissingDependencyError, match="Give the folder that contains 'many'"):
        folders.find("package://many/robots/leg/meshes/a.stl", "here")


def test_a_symbolic_link_out_of_the_folder_is_refused(tmp_path):
    (tmp_path / "secret.stl").write_text("solid")
    file = write_file(tmp_path / "up", urdf_xml(MESH.format("inner.stl")))
    (file.parent / "inner.stl").symlink_to(tmp_path / "secret.stl")
    with pytest.raises(ConfigurationError, match="a file inside"):
        read_urdf(file).links["a"].shapes[0].load_mesh()


@pytest.mark.parametrize("name", ["mesh.exe", "mesh.stl", "mesh.dae"])
def test_a_file_that_is_not_a_mesh_is_refused(tmp_path, name):
    file = write_file(tmp_path, urdf_xml(MESH.format(name)))
    (tmp_path / name).write_bytes(b"<not a mesh>" * 9)
    with pytest.raises(ConfigurationError, match="mesh"):
        read_urdf(file).links["a"].shapes[0].load_mesh()


def test_a_mesh_with_entities_is_refused(tmp_path):
    file = write_file(tmp_path, urdf_xml(MESH.format("mesh.dae")))
    (tmp_path / "mesh.dae").write_text(OUTSIDE)
    with pytest.raises(ConfigurationError, match="document type"):
        read_urdf(file).links["a"].shapes[0].load_mesh()


def test_a_missing_mesh_or_package_is_reported_with_the_expected_location(tmp_path):
    tree = read_urdf(
        write_file(
            tmp_path,
            urdf_xml(
                MESH.format("gone.stl"),
                MESH.replace('"a"', '"b"').format("package://absent_arm/x.stl"),
                joint_xml("j", "a", "b"),
            ),
        )
    )
    with pytest.raises(MissingDependencyError, match="It was expected at"):
        tree.links["a"].shapes[0].load_mesh()
    with pytest.raises(MissingDependencyError, match=r"'absent_arm'.*--packages FOLDER"):
        tree.links["b"].shapes[0].load_mesh()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot><link", "line 1, column"),
        ("<html/>", "root element"),
        ('<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="a"><xacro:arm/></robot>', "xacro"),
        (urdf_xml(link_xml("a"), link_xml("b")), "one tree with one root"),
        (urdf_xml(link_xml("a"), link_xml("a")), "more than once"),
        (urdf_xml(link_xml("a"), link_xml("b"), joint_xml("j", "a", "nowhere")), "nowhere"),
        (
            urdf_xml(link_xml("a"), link_xml("b"), link_xml("c"), joint_xml("j", "a", "c"), joint_xml("k", "b", "c")),
            "is the child of the joints 'j' and 'k'",
        ),
        (urdf_xml(link_xml("a"), link_xml("b"), joint_xml("j", "a", "b", axis="0 0 0")), "axis"),
        (urdf_xml(link_xml("a"), link_xml("b"), joint_xml("j", "a", "b", xyz="nan 0 0")), "finite"),
        (urdf_xml(link_xml("a"), link_xml("b"), joint_xml("j", "a", "b", kind="magnetic")), "magnetic"),
    ],
)
def test_an_invalid_description_is_refused_with_its_error(tmp_path, text, message):
    with pytest.raises(ConfigurationError, match=message):
        read_urdf(write_file(tmp_path, text))


def test_an_undeclared_namespace_prefix_is_ignored(tmp_path):
    extension = '<drake:proximity_properties><joint name="hidden"/></drake:proximity_properties>'
    text = urdf_xml(link_xml("a"), link_xml("b"), extension, joint_xml("j", "a", "b"))
    tree = read_urdf(write_file(tmp_path, text.replace("<axis", '<axis tool:note="é"')))
    assert [joint.name for joint in tree.joints] == ["j"]
    assert [joint.source_location for joint in tree.joints] == ["robot.urdf:6"]


def test_undeclared_names_get_a_namespace_of_their_own():
    root = safe_xml.parse_xml(b'<robot>\n<x:link y:name="b" name="a"/><link name="c"/></robot>', "robot.urdf")
    assert [element.tag for element in root] == ["{undeclared:x}link", "link"]
    assert dict(root[0].attrib) == {"name": "a", "{undeclared:y}name": "b"}
    assert root[0].sourceline == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot a:b='1'><link></robot>", r"line 1, column \d+.*mismatch"),
        ("<robot a:b='1' a:b='2'/>", "line 1, column 16.*duplicate attribute"),
        ("<robot a:b='1'>&unknown;</robot>", "Entity 'unknown' not defined"),
        ("<robot a:b='1'/><robot/>", "line 1, column 17.*junk after document element"),
        ("<a:robot/>", "root element"),
        ("<robot><xacro:arm/></robot>", "xacro"),
        ('<?xml version="1.0" encoding="shift_jis"?><robot a:b="1"/>', "line 1, column 1.*encoding"),
    ],
)
def test_an_undeclared_prefix_excuses_no_other_error(tmp_path, text, message):
    with pytest.raises(ConfigurationError, match=message):
        read_urdf(write_file(tmp_path, text))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_a_document_type_beside_an_undeclared_prefix_is_refused(encoding):
    text = f'<?xml version="1.0" encoding="{encoding}"?><!DOCTYPE robot [<!ENTITY x "y">]><robot a:b="1"/>'
    with pytest.raises(ConfigurationError, match="document type"):
        safe_xml.parse_xml(text.encode(encoding), "robot.urdf")


def test_a_description_above_the_size_limit_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr(safe_xml.read_bounded, "__defaults__", (100,))
    with pytest.raises(ConfigurationError, match=r"size of robot\.urdf"):
        read_urdf(write_file(tmp_path, urdf_xml(link_xml("a"))))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('<mujoco><asset><mesh file="../../secret.stl"/></asset></mujoco>', "a file inside"),
        ('<mujoco><compiler meshdir="/etc"/><asset><mesh file="passwd"/></asset></mujoco>', "a file inside"),
        ('<mujoco><include file="../secret.xml"/></mujoco>', "a file inside"),
        ('<mujoco><include file="robot.xml"/></mujoco>', "levels"),
        ('<mujoco><asset><mesh file="a.stl"/></asset><include file="folder.xml"/></mujoco>', "a file inside"),
        ('<mujoco><compiler strippath="true" meshdir="/etc"/></mujoco>', "strippath"),
        ('<mujoco><compiler meshdir="a"/><include file="folder.xml"/></mujoco>', "in every file"),
        ('<mujoco><asset><model name="m" file="folder.xml"/></asset></mujoco>', "another model"),
        ('<mujoco><extension><plugin plugin="mujoco.pid"/></extension></mujoco>', "plugin"),
        ("<mujoco><worldbody><geom/></worldbody></mujoco>", "MuJoCo compiles"),
    ],
)
def test_mjcf_reads_no_file_outside_the_folder_and_loads_no_plugin(tmp_path, text, message):
    for path in (tmp_path / "secret.xml", tmp_path / "secret.stl"):
        path.write_text("<mujoco/>")
    file = write_file(tmp_path / "in", text, "robot.xml")
    (file.parent / "folder.xml").write_text('<mujoco><compiler meshdir="/etc"/></mujoco>')
    (file.parent / "a.stl").write_text("solid")
    with pytest.raises(ConfigurationError, match=message):
        read_description(file)


NAN = float("nan")


@pytest.mark.parametrize("attribute", ["pos='0 nan 0.3'", "quat='1 0 nan 0'", "pos='0 0 0' axisangle='0 0 1 nan'"])
def test_an_mjcf_with_a_pose_that_is_not_finite_is_refused(tmp_path, attribute):
    path = tmp_path / "robot.xml"
    path.write_text(
        f"<mujoco><worldbody><body name='a'><geom size='0.1'/><body name='b' {attribute}>"
        "<joint name='j' axis='0 0 1'/><geom size='0.1'/></body></body></worldbody></mujoco>"
    )
    with pytest.raises(ConfigurationError):
        read_mjcf(path)


@pytest.mark.parametrize(
    "changes",
    [
        {"pose": np.full((4, 4), NAN)},
        {"axis": np.array([0.0, np.inf, 1.0])},
        {"lower": NAN},
        {"upper": float("inf")},
        {"velocity": NAN},
        {"acceleration": NAN},
        {"jerk": NAN},
        {"effort": NAN},
        {"mimic": Mimic("k", NAN, 0.0)},
        {"mimic": Mimic("k", 1.0, NAN)},
    ],
)
def test_a_joint_with_a_number_that_is_not_finite_is_refused_by_every_reader(changes):
    valid = {"pose": np.eye(4), "axis": np.array([0.0, 0.0, 1.0]), "lower": -1.0, "upper": 1.0}
    for given, finite in ((valid, True), (valid | changes, False)):
        joint = TreeJoint(name="j", kind="revolute", parent="a", child="b", source_location="f:1", **given)
        links = {name: TreeLink(name) for name in "ab"}
        tree = KinematicTree(name="r", source="f", licence="", links=links, joints=(joint,))
        if finite:
            assert tree.validate() is tree
        else:
            with pytest.raises(ConfigurationError, match=r"joint 'j' \(f:1\)"):
                tree.validate()
