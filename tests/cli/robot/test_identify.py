"""dualbrain robot identify: the figures, the data file they go into, and what is refused."""

import json

import msgspec
import numpy as np
import pytest

from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.robots.loader import encode_robot, load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.kernel import tracking_errors

PANDA = load_robot("panda")
SHORT = ("--seeds", 1, "--seconds", 0.5)


def test_it_reports_the_model_and_how_to_store_it(run_command):
    code, out, _ = run_command("robot", "identify", *SHORT, "--load", 0.3)
    assert code == ExitCode.SUCCESS
    for word in ("lag", "position errors", "margins α e of the rows", "stored model", "--write"):
        assert word in out


def test_the_help_states_the_purpose(run_command):
    listed = " ".join(run_command("robot", "--help")[1].split())
    assert "identify its tracking model" in listed
    assert "Identify how closely the drive of a simulated robot follows its" in listed
    out = run_command("robot", "identify", "--help")[1]
    for word in ("y = q + lag v", "leaky integral", "--load", "FilterConfig(tracking_error=...)"):
        assert word in " ".join(out.split())


def test_json_and_a_new_data_file(run_command, tmp_path):
    code, out, err = run_command("robot", "identify", *SHORT, "--drive", "velocity", "--json", "--write", "body.json")
    assert code == ExitCode.SUCCESS
    entry = json.loads(out)["entry"]
    assert "body.json" in err
    robot_model = msgspec.json.decode((tmp_path / "body.json").read_bytes(), type=RobotModel)
    assert json.loads(msgspec.json.encode(robot_model.with_drive("velocity").tracking)) == entry
    assert robot_model.tracking == PANDA.tracking, "the other drive is left alone"
    assert "--drive velocity --seeds 1 --seconds 0.5 --load 0.5" in entry["provenance"]
    assert encode_robot(robot_model) == (tmp_path / "body.json").read_bytes()


def test_what_is_written_enters_the_rows(run_command, tmp_path):
    (tmp_path / "body.json").write_bytes(encode_robot(PANDA))
    run_command("robot", "identify", *SHORT, "--load", 1, "--write", "body.json")
    robot_model = msgspec.json.decode((tmp_path / "body.json").read_bytes(), type=RobotModel)
    assert robot_model.tracking != PANDA.tracking
    errors = np.array(robot_model.tracking.position_error)
    assert errors.shape == (7,)
    assert len(set(errors.tolist())) > 1
    np.testing.assert_allclose(tracking_errors(robot_model, FilterConfig()), robot_model.alpha * errors)
    assert np.all(tracking_errors(robot_model, FilterConfig(alpha=10.0)) > 10.0 * errors)
    assert np.all(tracking_errors(robot_model, FilterConfig(tracking_error=0.5)) == 0.5)


@pytest.mark.parametrize(
    "bad",
    [
        ("--drive", "magnetic"),
        ("--robot", "pandas"),
        ("--seeds", 0),
        ("--seconds", 0.01),
        ("--load", -1),
    ],
)
def test_refusals_are_one_line(run_command, bad):
    code, out, err = run_command("robot", "identify", *bad)
    assert (code, out) == (ExitCode.SETUP, "")
    assert "Traceback" not in err


def test_a_file_that_is_no_body_is_left_alone(run_command, tmp_path):
    (tmp_path / "body.json").write_text("{}")
    code, _, err = run_command("robot", "identify", *SHORT, "--write", "body.json")
    assert code == ExitCode.SETUP
    assert "not a robot model" in err
    assert (tmp_path / "body.json").read_text() == "{}"


@pytest.mark.parametrize(
    ("entries", "word"),
    [
        ({"period": 0.0}, "period in body.json: got 0.0"),
        ({"home": (0.0,) * 3}, "home in body.json"),
    ],
)
def test_a_file_with_a_wrong_entry_is_left_alone(run_command, tmp_path, entries, word):
    data = encode_robot(msgspec.structs.replace(PANDA, **entries))
    (tmp_path / "body.json").write_bytes(data)
    code, _, err = run_command("robot", "identify", *SHORT, "--write", "body.json")
    assert code == ExitCode.SETUP
    assert word in " ".join(err.split())
    assert (tmp_path / "body.json").read_bytes() == data


def test_the_file_of_a_robot_with_other_joints_and_a_folder_are_refused(run_command, tmp_path):
    (tmp_path / "body.json").write_bytes(encode_robot(load_robot("ur5e")))
    code, _, err = run_command("robot", "identify", *SHORT, "--write", "body.json")
    assert code == ExitCode.SETUP
    assert "joints in body.json" in err
    (tmp_path / "arm").mkdir()
    code, _, err = run_command("robot", "identify", *SHORT, "--write", "arm")
    assert code == ExitCode.SETUP
    assert "arm/body.json" in err
