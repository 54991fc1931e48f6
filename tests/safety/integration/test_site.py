"""Site files: errors name line and column, limits only narrow, and the filter keeps planes, boxes, tool and payload."""

import numpy as np
import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.robots.loader import load_robot
from dualbrain.robots.site_config import SiteError, read_site
from dualbrain.safety.barriers.scenarios import EXACT_TRACKING
from dualbrain.safety.integration.site import site_filter, site_obstacles, site_robot, site_skill_grants
from dualbrain.skills import parameters

WHOLE = """
[robot]
tool_speed = 0.2

[limits]
velocity = 2.0

[joint.panda_joint4]
acceleration = 5.0
lower = -2.9

[tool]
position = [0, 0, 0.1]
[[tool.spheres]]
centre = [0, 0, 0.05]
radius = 0.04

[payload]
error = 0.01
[[payload.spheres]]
centre = [0, 0, 0.14]
radius = 0.03

[[plane]]
name = "table"
point = [0, 0, 0]
inward = [0, 0, 1]
parts = ["hand"]

[[keep_out]]
name = "cabinet"
position = [0.6, 0.4, 0.3]
half_extents = [0.1, 0.1, 0.3]
yaw = 0.3

[commander.planner]
skills = ["home", "hold"]
"""


def site(folder, text):
    path = folder / "lab.toml"
    path.write_text(text)
    return read_site(path)


PLANE = "[[plane]]\nname = 'a'\npoint = [0, 0, 0]\ninward = [0, 0, 1]\n"


@pytest.mark.parametrize(
    ("text", "line", "column", "expected"),
    [
        ("[robot]\nperiod = 0.0", 2, 10, "> 0.0"),
        ('[limits]\n\nvelocity = "fast"', 3, 12, "limits.velocity must be a number, but is a text."),
        (
            "[limits]\nvelocty = 1.0",
            2,
            11,
            "unknown entry 'velocty' in [limits]; closest: 'velocity'; known: velocity, acceleration, jerk.",
        ),
        ("[robt]\nperiod = 1", 1, 1, "unknown entry 'robt' in the file; closest: 'robot'"),
        ("[joint.elbow]\nlower = nan", 2, 9, "not finite"),
        (f"{PLANE}[[plane]]\nname = 'b'\npoint = [0, 0]\ninward=[0,0,1]", 7, 9, "length"),
        ("[[keep_out]]\nname = 'box'\nposition = [0, 0, 0]\n", 1, 1, "[[keep_out]] lacks the entry 'half_extents'."),
        ("[tool]\nspheres = [{centre=[0, 0, 0], radus=1}]", 2, 11, "closest: 'radius'; known: centre, radius."),
        ("[commander.planer]\nskills = ['home']", 1, 1, "unknown principal 'planer'"),
        ("commander = 3", 1, 13, "commander must be a table, but is an integer."),
        ("[robot]\nperiod = = 2", 2, 10, "Invalid value"),
        ("[commander.planner]\nskills = 'all'", 2, 10, "array"),
    ],
)
def test_an_error_names_its_line_and_column(tmp_path, text, line, column, expected):
    with pytest.raises(SiteError) as caught:
        site(tmp_path, text)
    assert (caught.value.line, caught.value.column) == (line, column)
    assert f"lab.toml, line {line}, column {column}" in str(caught.value)
    assert expected in str(caught.value)


@pytest.mark.parametrize(
    ("text", "line", "expected"),
    [
        ("[joint.elbow]\nvelocity = 1.0", 1, "panda_joint1"),
        ("[[plane]]\nname = 'a'\npoint = [0, 0, 0]\ninward = [0, 0, 1]\nparts = ['tail']", 5, "tail"),
        ("[[plane]]\nname = 'a'\npoint = [0, 0, 0]\ninward = [0, 0, 0]", 4, "not zero"),
        ("[joint.panda_joint1]\nlower = 2.9", 1, "not empty"),
    ],
)
def test_an_entry_that_does_not_fit_the_robot_names_its_line(tmp_path, text, line, expected):
    file, robot_model = site(tmp_path, text), load_robot("panda")
    with pytest.raises(SiteError) as caught:
        site_obstacles(site_robot(robot_model, file), file)
    assert caught.value.line == line
    assert expected in str(caught.value)


def test_limits_only_narrow_and_have_their_provenance(tmp_path):
    robot_model = load_robot("panda")
    narrowed = site_robot(robot_model, site(tmp_path, WHOLE))
    fourth = narrowed.joints[3]
    assert [joint.velocity.value for joint in narrowed.joints] == [2.0] * 7
    assert (fourth.acceleration.value, fourth.lower.value) == (5.0, -2.9)
    assert fourth.acceleration.provenance.startswith("site policy (lab.toml:9); wider: 12.5 of")
    assert narrowed.tool_speed.value == 0.2
    wide = site_robot(robot_model, site(tmp_path, "[limits]\nvelocity = 9.0\n[joint.panda_joint1]\nlower = -9.0\n"))
    assert wide == robot_model


@pytest.mark.parametrize("robot", ["base", "mobile_panda"])
def test_the_tool_speed_and_the_turn_limits_narrow_the_motion_of_a_base(tmp_path, robot):
    text = "[robot]\ntool_speed = 0.2\nturn = 0.3\nturn_acceleration = 0.4\n"
    safety = site_filter(site(tmp_path, text), load_robot(robot))
    drive, turn, *arm = safety.robot_model.joints
    assert (drive.velocity.value, turn.velocity.value, turn.acceleration.value) == (0.2, 0.3, 0.4)
    assert drive.velocity.provenance.startswith("site policy (lab.toml:2); wider: ")
    assert tuple(arm) == load_robot(robot).joints[2:]
    assert parameters.max_speed(safety.robot_model).upper == 0.2
    u, fast = np.zeros(len(safety.robot_model.joints)), np.zeros(len(safety.robot_model.joints))
    fast[:2] = 0.5
    for _ in range(500):
        u = safety(np.array(safety.robot_model.home), u, fast).u
    assert u[0] == pytest.approx(0.2, rel=1e-3)
    assert 0.0 < u[1] <= 0.3 + 1e-6


@pytest.mark.parametrize(
    ("robot", "text", "entry"),
    [
        ("panda", "[robot]\nturn = 1.0", "robot.turn: .*mobile base; panda has none"),
        ("ur5e", "[robot]\nturn_acceleration = 1.0", "robot.turn_acceleration: .*mobile base; ur5e has none"),
        ("ur5e", "[limits]\njerk = 10.0", "limits.jerk: .*ur5e has no limit of the jerk"),
        ("base", "[limits]\njerk = 10.0", "limits.jerk: .*base has no limit of the jerk"),
        ("mobile_panda", "[joint.drive]\njerk = 10.0", "joint.drive.jerk: .*no limit of the jerk"),
    ],
)
def test_a_limit_that_nothing_of_the_robot_uses_is_refused(tmp_path, robot, text, entry):
    with pytest.raises(SiteError, match=f"lab.toml, line 2, column .*{entry}"):
        site_robot(load_robot(robot), site(tmp_path, text))


def test_a_jerk_limit_of_every_joint_narrows_the_joints_that_have_one(tmp_path):
    drive, turn, *arm = site_robot(load_robot("mobile_panda"), site(tmp_path, "[limits]\njerk = 10.0")).joints
    assert drive.jerk is turn.jerk is None
    assert {joint.jerk.value for joint in arm} == {10.0}


def test_tool_and_payload_become_links_that_keep_away_like_the_hand(tmp_path):
    robot_model, file = load_robot("panda"), site(tmp_path, WHOLE)
    narrowed = site_robot(robot_model, file)
    plain, longer = site_filter(site(tmp_path, ""), robot_model), site_filter(file, robot_model)
    q = np.array(robot_model.home)
    assert np.allclose(longer.tool(q).position, plain.tool(q).position + 0.1 * plain.tool(q).rotation[:, 2], atol=1e-6)
    centres, radii, groups = longer.spheres(q, 0.0)
    assert len(radii) == len(robot_model.spheres) + 2
    assert groups[-2:] == ("hand", "hand")
    assert radii[-2:] == pytest.approx([0.04, 0.03 + 0.01], abs=1e-6)
    centre = plain.tool(q).position + 0.14 * plain.tool(q).rotation[:, 2]
    assert np.allclose(centres[-1], centre, atol=1e-6)
    kept = {pair for pair in narrowed.self_pairs.kept if "site_payload" in pair}
    assert kept
    assert {part for part, _ in kept} <= {part for pair in robot_model.self_pairs.kept for part in pair}


def test_the_filter_keeps_the_payload_above_the_table(tmp_path):
    safety = site_filter(site(tmp_path, WHOLE), load_robot("panda"), EXACT_TRACKING)
    q, u = np.array(safety.robot_model.home), np.zeros(7)
    for _ in range(3000):
        J = safety.tool(q).jacobian[:3]
        u = safety(q, u, J.T @ np.linalg.solve(J @ J.T + 1e-3 * np.eye(3), np.array([0.0, 0.0, -0.3]))).u
        q = q + safety.robot_model.period * u
    centres, radii, groups = safety.spheres(q, 0.0)
    hand = np.array([group == "hand" for group in groups])
    assert 0.0 <= np.min(centres[hand, 2] - radii[hand]) < 0.01


def test_grants_list_the_skills_of_each_commander(tmp_path):
    skills = frozenset({"home", "hold", "grasp"})
    assert site_skill_grants(site(tmp_path, WHOLE), skills) == {"planner": frozenset({"home", "hold"})}
    assert site_skill_grants(site(tmp_path, ""), skills) is None
    with pytest.raises(SiteError, match="line 37"):
        site_skill_grants(site(tmp_path, WHOLE), frozenset({"home"}))


def test_a_missing_file_is_a_configuration_error(tmp_path):
    with pytest.raises(ConfigurationError, match="site file"):
        read_site(tmp_path / "gone.toml")
