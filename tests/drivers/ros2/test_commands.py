"""The commands `dualbrain ros2`: tables of the controller, options that replace parameters, and wrong set-ups."""

import msgspec
import pytest

from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.main import run_command_line
from dualbrain.drivers.ros2.assembly import make_command_filter
from dualbrain.drivers.ros2.parameters import NodeParameters
from dualbrain.errors import ConfigurationError
from dualbrain.robots.importer.build_arm import unidentified_tracking
from dualbrain.robots.loader import encode_robot, load_robot
from dualbrain.safety.integration.kernel_tables import HEADER

SITE = '[[plane]]\nname = "table"\npoint = [0, 0, -0.05]\ninward = [0, 0, 1]\nparts = ["arm", "hand"]\n'
PARAMETERS = "/**:\n  ros__parameters:\n    robot: panda\n"


@pytest.fixture
def site(tmp_path):
    path = tmp_path / "site.toml"
    path.write_text(SITE)
    return path


def test_the_tables_have_robot_period_and_obstacles(tmp_path, site, capsys):
    out = tmp_path / "ur5e.tables"
    arguments = ["ros2", "tables", "--robot", "ur5e", "--site", str(site), "--period", "0.002", "--out", str(out)]
    assert run_command_line(arguments) == ExitCode.SUCCESS
    assert "ur5e at 500 Hz, 1 obstacles" in capsys.readouterr().err
    lines = out.read_text("utf-8").splitlines()
    assert lines[0] == HEADER
    assert "period 1 0.002" in lines
    assert next(line for line in lines if line.startswith("obstacles ")).startswith("obstacles 29 ")


def test_the_objects_of_a_scene_are_obstacles(tmp_path):
    out = tmp_path / "panda.tables"
    assert run_command_line(["ros2", "tables", "--scene", "tabletop:0", "--out", str(out)]) == ExitCode.SUCCESS
    count = int(next(line for line in out.read_text("utf-8").splitlines() if line.startswith("obstacles ")).split()[1])
    assert count >= 2 * 29


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["tables", "--out", "x"], "There is no obstacle"),
        (["tables", "--out", "x", "--period", "0.5"], "control period"),
        (["node", "--robot", "panda"], "There is no obstacle"),
        (["node", "--params", "no.yaml"], "no file"),
        (["node", "--params", "node.yaml", "--robot", "pando"], "Closest: 'panda'"),
        (["node", "--params", "node.yaml", "--commands", "a b"], "command_topic"),
        (["node", "--params", "node.yaml", "--commands", "/a", "--safe-commands", "a"], "its own commands"),
    ],
)
def test_a_wrong_set_up_ends_with_its_remedy(tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "node.yaml").write_text(PARAMETERS)
    assert run_command_line(["ros2", *arguments]) == ExitCode.SETUP
    assert words in capsys.readouterr().err


def test_a_robot_whose_tracking_error_is_not_identified_is_refused(tmp_path, site, capsys):
    model = msgspec.structs.replace(load_robot("panda"), tracking=unidentified_tracking())
    (tmp_path / "body.json").write_bytes(encode_robot(model))
    out = tmp_path / "panda.tables"
    tables = ["ros2", "tables", "--robot", str(tmp_path), "--site", str(site), "--out", str(out)]
    assert run_command_line(tables) == ExitCode.SETUP
    assert "dualbrain robot identify" in capsys.readouterr().err
    assert not out.exists()
    with pytest.raises(ConfigurationError, match="not identified"):
        make_command_filter(NodeParameters(robot=str(tmp_path), site=str(site)))


def test_a_wrong_domain_of_the_environment_is_an_error(monkeypatch, site, capsys):
    monkeypatch.setenv("ROS_DOMAIN_ID", "233")
    assert run_command_line(["ros2", "node", "--robot", "panda", "--site", str(site)]) == ExitCode.SETUP
    assert "ROS_DOMAIN_ID" in capsys.readouterr().err
