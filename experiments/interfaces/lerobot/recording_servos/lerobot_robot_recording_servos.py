"""A robot of LeRobot whose servos follow with a lag and record the values sent to them, and a careless teleoperator.

Every command is one line of JSON in the file `log`: the time, the name of the thread, and the values.
"""

import json
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
HOME = (0.0, -34.4, 17.2, 85.9, 0.0, 30.0)
LAG = 0.03
ACTIONS = ((40.0, 60.0, 45.0, 30.0, 60.0, 80.0), (20.0, 70.0, 60.0, 20.0, -60.0, 10.0))
"""Goals [deg] that lead through the table."""


@RobotConfig.register_subclass("recording_servos")
@dataclass(kw_only=True)
class RecordingServosConfig(RobotConfig):
    """`log`: file of the commands; "" records nothing."""

    log: str = ""


class RecordingServos(Robot):
    """Servos with a first-order lag in real time."""

    config_class = RecordingServosConfig
    name = "recording_servos"

    def __init__(self, config):
        super().__init__(config)
        self.config, self.cameras = config, {}
        self._connected = False
        self._values, self._goal, self._time = list(HOME), list(HOME), time.monotonic()

    @property
    def observation_features(self):
        """One position per servo."""
        return {f"{name}.pos": float for name in JOINTS}

    @property
    def action_features(self):
        """One position per servo."""
        return self.observation_features

    @property
    def is_connected(self):
        """Whether it is connected."""
        return self._connected

    @property
    def is_calibrated(self):
        """Always."""
        return True

    def connect(self, calibrate=True):
        """Connect."""
        self._connected = True

    def calibrate(self):
        """Nothing to do."""

    def configure(self):
        """Nothing to do."""

    def disconnect(self):
        """Disconnect."""
        self._connected = False

    def get_observation(self):
        """Positions [deg] that approach the goal with the lag."""
        now = time.monotonic()
        share = min(1.0, (now - self._time) / LAG)
        self._values = [value + share * (goal - value) for value, goal in zip(self._values, self._goal, strict=True)]
        self._time = now
        return {f"{name}.pos": value for name, value in zip(JOINTS, self._values, strict=True)}

    def send_action(self, action):
        """Record the values, and take them as the goal."""
        self.get_observation()
        values = {key: float(value) for key, value in action.items()}
        if self.config.log:
            line = {"time": time.monotonic(), "thread": threading.current_thread().name, "values": values}
            with Path(self.config.log).open("a") as file:
                file.write(json.dumps(line) + "\n")
        self._goal = [values[f"{name}.pos"] for name in JOINTS]
        return action


@TeleoperatorConfig.register_subclass("careless_operator")
@dataclass(kw_only=True)
class CarelessOperatorConfig(TeleoperatorConfig):
    """No options."""


class CarelessOperator(Teleoperator):
    """Commands goals that lead through the table, each for half a second."""

    config_class = CarelessOperatorConfig
    name = "careless_operator"

    def __init__(self, config):
        super().__init__(config)
        self._start = time.monotonic()

    @property
    def action_features(self):
        """One position per servo."""
        return {f"{name}.pos": float for name in JOINTS}

    @property
    def feedback_features(self):
        """None."""
        return {}

    @property
    def is_connected(self):
        """Whether it is connected."""
        return True

    @property
    def is_calibrated(self):
        """Always."""
        return True

    def connect(self, calibrate=True):
        """Connect."""
        self._start = time.monotonic()

    def calibrate(self):
        """Nothing to do."""

    def configure(self):
        """Nothing to do."""

    def get_action(self):
        """The goal of this moment [deg]."""
        chosen = ACTIONS[int(2.0 * (time.monotonic() - self._start)) % len(ACTIONS)]
        return {f"{name}.pos": value for name, value in zip(JOINTS, chosen, strict=True)}

    def send_feedback(self, feedback):
        """Nothing to do."""

    def disconnect(self):
        """Nothing to do."""
