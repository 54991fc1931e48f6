"""Every stated limit of a mobile base, of its wheels and of its two joints narrows the model, or is refused."""

import pytest

from dualbrain.cli.main import run_command_line
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.importer.build_arm import ImportOptions
from dualbrain.robots.importer.build_mobile_base import build_base
from dualbrain.robots.importer.required_limits import MissingLimitsError, make_limit_policy
from dualbrain.robots.importer.urdf import read_urdf
from dualbrain.robots.site_config import read_site
from tests.robots.importer.urdf_builder import joint_xml, link_xml, urdf_xml, write_file

QUICK = ImportOptions(quick=True, sphere_budget=20)
OPTIONS = {"period": 0.02, "acceleration": 1.0, "turn_acceleration": 2.0}
WHEELS = ("left", "right")
RADIUS, TRACK, RATE = 0.1, 0.4, 10.0


def rover_xml(limit=f'<limit velocity="{RATE}" effort="1"/>'):
    shape = f'<geometry><cylinder radius="{RADIUS}" length="0.04"/></geometry><origin rpy="1.5707963 0 0"/>'
    wheels = [f'<link name="wheel_{side}"><collision>{shape}</collision></link>' for side in WHEELS]
    joints = [
        joint_xml(side, "body", f"wheel_{side}", "continuous", "0 1 0", f"0 {y} 0", inside=limit)
        for side, y in (("left", 0.5 * TRACK), ("right", -0.5 * TRACK))
    ]
    lift = joint_xml("lift", "body", "mast", "prismatic", "0 0 1", "0 0 0.1")
    return urdf_xml(link_xml("body", (0.4, 0.3, 0.1), (0, 0, 0.05)), link_xml("mast"), *wheels, *joints, lift)


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    return read_urdf(write_file(tmp_path_factory.mktemp("rover"), rover_xml()))


def build(tree, tmp_path, site="", wheels=WHEELS, **options):
    file = read_site(write_file(tmp_path, site, "site.toml"))
    return build_base(tree, make_limit_policy(file, OPTIONS | options), QUICK, wheels).robot_model


def speeds(model):
    return [joint.velocity.value for joint in model.joints]


def accelerations(model):
    return [joint.acceleration.value for joint in model.joints]


def test_the_radius_of_a_cylindrical_wheel_is_that_of_the_description(tree, tmp_path):
    assert speeds(build(tree, tmp_path)) == pytest.approx([0.5 * RATE * RADIUS, RATE * RADIUS / TRACK], rel=1e-6)


@pytest.mark.parametrize(
    ("site", "options"),
    [
        ("", {"velocity": 2.0}),
        ("[limits]\nvelocity = 2.0\n", {}),
        ("[joint.left]\nvelocity = 2.0\n", {}),
        ("[joint.right]\nvelocity = 2.0\n", {"velocity": 9.0}),
    ],
)
def test_a_limit_of_the_rate_of_a_wheel_narrows_speed_and_turn_rate(tree, tmp_path, site, options):
    model = build(tree, tmp_path, site, **options)
    assert speeds(model) == pytest.approx([0.1, 0.5], rel=1e-6)
    assert "site policy" in model.joints[0].velocity.provenance


@pytest.mark.parametrize("wheels", [WHEELS, None])
def test_limits_of_driving_and_turning_narrow_those_of_the_robot(tree, tmp_path, wheels):
    site = """
        [joint.drive]
        velocity = 0.3
        acceleration = 0.4
        [joint.turn]
        velocity = 0.2
        acceleration = 0.6
    """
    model = build(tree, tmp_path, site, wheels, tool_speed=0.4, turn=1.0)
    assert (speeds(model), accelerations(model)) == ([0.3, 0.2], [0.4, 0.6])
    assert model.tool_speed.value == 0.3


def test_a_velocity_of_all_joints_counts_without_wheels(tree, tmp_path):
    assert speeds(build(tree, tmp_path, wheels=None, velocity=0.25, tool_speed=0.4, turn=1.0)) == [0.25, 0.25]


def test_the_acceleration_of_a_wheel_bounds_driving_and_turning_together(tree, tmp_path):
    model = build(tree, tmp_path, "[joint.left]\nacceleration = 6.0\n", acceleration=0.4)
    drive, turn = accelerations(model)
    assert (drive, turn) == pytest.approx((0.4, 1.0), rel=1e-6)
    assert drive + 0.5 * TRACK * turn <= 6.0 * RADIUS + 1e-6


def test_a_stated_rate_supplies_that_which_the_description_lacks(tmp_path):
    tree = read_urdf(write_file(tmp_path, rover_xml("")))
    with pytest.raises(MissingLimitsError) as caught:
        build(tree, tmp_path)
    assert {(one.owner, one.limit) for one in caught.value.missing} == {("left", "velocity"), ("right", "velocity")}
    assert speeds(build(tree, tmp_path, velocity=RATE)) == pytest.approx([0.5, 2.5], rel=1e-6)


@pytest.mark.parametrize(
    ("site", "match"),
    [
        ("[joint.lift]\nvelocity = 1.0\n", r"velocity of 'lift' \(site policy \(site\.toml:2\)\).*drive, left, right"),
        ("[joint.left]\nlower = 1.0\n", "lower of 'left'"),
        ("[joint.turn]\njerk = 1.0\n", "jerk of 'turn'"),
    ],
)
def test_a_limit_that_a_base_does_not_keep_is_refused(tree, tmp_path, site, match):
    with pytest.raises(ConfigurationError, match=match):
        build(tree, tmp_path, site)


def test_a_limit_of_an_unknown_joint_is_refused(tree, tmp_path):
    with pytest.raises(UnknownNameError, match="Closest: 'left'"):
        build(tree, tmp_path, "[joint.lefft]\nvelocity = 1.0\n")


@pytest.mark.parametrize("limit", ['<limit velocity="1" drake:acceleration="0"/>'])
def test_a_limit_of_zero_of_a_wheel_is_refused(tmp_path, limit):
    tree = read_urdf(write_file(tmp_path, rover_xml(limit)))
    with pytest.raises(ConfigurationError, match=r"acceleration of 'left'.*above 0"):
        build(tree, tmp_path)


@pytest.mark.parametrize(
    "options",
    [["--wheels", "left,right"], *(["--base", "differential", *one] for one in (["--home", "0"], ["--grip", "5"]))],
)
def test_an_option_of_another_kind_of_robot_is_refused(tmp_path, capsys, options):
    file = write_file(tmp_path, rover_xml())
    assert run_command_line(["robot", "init", str(file), "--out", str(tmp_path / "out"), *options]) == 2
    assert "no such option for" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
