"""Checks of the guarded robot and of the processor step through LeRobot's own classes; the first failure ends it.

Runs in the environment of `virtual_environment`: python check_guarded_robot.py FOLDER
"""

import sys
import time
from pathlib import Path

from lerobot.processor import RobotProcessorPipeline, TransitionKey
from lerobot.processor.converters import robot_action_observation_to_transition, transition_to_robot_action
from lerobot.robots.so_follower import SO101FollowerConfig
from lerobot.robots.utils import make_robot_from_config
from lerobot.teleoperators.utils import TeleopEvents
from lerobot.utils.import_utils import register_third_party_plugins

register_third_party_plugins()

from lerobot_robot_dualbrain import DualbrainGuardedConfig, DualbrainSafetyFilterStep  # noqa: E402
from lerobot_robot_dualbrain.connector import connector  # noqa: E402
from lerobot_robot_recording_servos import ACTIONS, JOINTS, RecordingServosConfig  # noqa: E402

UNSAFE = {f"{name}.pos": value for name, value in zip(JOINTS, ACTIONS[0], strict=True)}


def message(action):
    """The text of the error that `action` raises."""
    try:
        action()
    except Exception as error:  # any error: the text is checked
        return str(error)
    raise AssertionError("no error was raised")


def guarded(**options):
    inner = options.pop("inner", None) or RecordingServosConfig()
    return make_robot_from_config(DualbrainGuardedConfig(inner=inner, **options))


def check_refusals(folder):
    range_units = SO101FollowerConfig(port="none", id="a", calibration_dir=folder, use_degrees=False)
    assert "use_degrees: true" in message(lambda: guarded(inner=range_units))
    clamped = SO101FollowerConfig(port="none", id="a", calibration_dir=folder, max_relative_target=5.0)
    assert "max_relative_target" in message(lambda: guarded(inner=clamped))
    assert "does not report its units" in message(guarded)
    assert "has the digest" in message(lambda: guarded(units="degrees", digest="0123456789abcdef"))
    assert "panda_joint1" in message(lambda: guarded(units="degrees", model="panda"))
    assert "cannot be used" in message(lambda: guarded(inner={"type": "no_such_robot"}))
    follower = SO101FollowerConfig(port="none", id="a", calibration_dir=folder)
    robot = guarded(inner=follower)
    assert list(robot.action_features) == [f"{name}.pos" for name in JOINTS]
    calibrated = guarded(units="degrees", calibration={"shoulder_pan": {"offset": -200.0}})
    assert "shoulder_pan.pos reads 200.0° after calibration" in message(calibrated.connect)
    assert not calibrated.is_connected


def check_robot():
    robot = guarded(units="degrees", mark_interventions=True)
    assert "Connect the robot first" in message(lambda: robot.send_action(UNSAFE))
    robot.connect()
    assert set(robot.get_observation()) == set(robot.observation_features) == {*robot.action_features, "intervention"}
    sent = robot.send_action({"elbow": 1.0})
    assert set(sent) == set(robot.action_features)
    assert "lacks shoulder_pan.pos" in robot.state.problem
    marks = []
    for _ in range(60):
        sent = robot.send_action(UNSAFE)
        time.sleep(1 / 30)
        marks.append(robot.get_observation()["intervention"])
    assert sent["gripper.pos"] == UNSAFE["gripper.pos"]
    assert abs(sent["shoulder_lift.pos"] - UNSAFE["shoulder_lift.pos"]) > 10.0
    assert marks[-1] == 1.0
    assert not robot.state.problem
    assert "writes to the guarded robot" in message(lambda: robot.inner.robot.send_action(UNSAFE))
    deadline = time.monotonic() + 2.0
    while "writes to the guarded robot" not in robot.state.problem:
        assert time.monotonic() < deadline
    robot.disconnect()
    assert not robot.is_connected


def check_step(folder):
    step = DualbrainSafetyFilterStep(action_rate=30.0)
    pipeline = RobotProcessorPipeline(
        steps=[step],
        to_transition=robot_action_observation_to_transition,
        to_output=transition_to_robot_action,
    )
    here = {f"{name}.pos": value for name, value in zip(JOINTS, (0.0, -34.4, 17.2, 85.9, 0.0, 30.0), strict=True)}
    beyond = here | {"shoulder_pan.pos": 200.0}
    assert "shoulder_pan.pos reads 200.0° after calibration" in message(lambda: pipeline((dict(UNSAFE), beyond)))
    assert "no finite number for shoulder_pan.pos" in message(lambda: pipeline((dict(UNSAFE), {})))
    for _ in range(100):
        here = pipeline((dict(UNSAFE), here))
        time.sleep(0.001)
    assert here["gripper.pos"] == UNSAFE["gripper.pos"]
    assert abs(here["shoulder_lift.pos"] - UNSAFE["shoulder_lift.pos"]) > 10.0
    changed = step(robot_action_observation_to_transition((dict(UNSAFE), here)))
    assert changed[TransitionKey.INFO][TeleopEvents.IS_INTERVENTION] is True
    pipeline.save_pretrained(folder)
    (file,) = folder.glob("*.json")
    loaded = RobotProcessorPipeline.from_pretrained(folder, config_filename=file.name)
    assert loaded.steps[0].get_config() == step.get_config()


if __name__ == "__main__":
    target = Path(sys.argv[1])
    check_refusals(target)
    check_robot()
    assert connector().check() == []
    (target / "pipeline").mkdir()
    check_step(target / "pipeline")
    print("checked")
