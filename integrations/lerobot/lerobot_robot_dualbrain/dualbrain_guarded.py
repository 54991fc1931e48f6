"""The guarded robot: everything is that of the inner robot, but the commands that it gets."""

from functools import cached_property
from typing import Any

from lerobot.robots import Robot
from lerobot.robots.utils import make_robot_from_config

from dualbrain.errors import ConfigurationError
from dualbrain.safety.integration.servo_bus.bus_thread import BusThread
from dualbrain.safety.integration.servo_bus.guarded_servos import ServoState
from dualbrain.safety.integration.servo_bus.servo_settings import make_guarded_servos
from lerobot_robot_dualbrain.config_dualbrain_guarded import DualbrainGuardedConfig
from lerobot_robot_dualbrain.inner_robot import InnerRobot, check_configuration

INTERVENTION = "intervention"
"""Name of the entry of the observation that marks frames in which the guard changed the motion."""


class DualbrainGuarded(Robot):
    """A robot of LeRobot behind the guard; `send_action` is the only way to its servos.

    A thread reads the joints and writes the newest safe target, also between two actions.
    """

    config_class = DualbrainGuardedConfig
    name = "dualbrain_guarded"

    def __init__(self, config: DualbrainGuardedConfig, inner: Robot | None = None) -> None:
        """Guard the robot that `config` describes, or `inner`.

        Raises:
            ConfigurationError, UnknownNameError: a setting cannot be used, or does not fit the robot.
        """
        super().__init__(config)
        self.config = config
        robot = inner or make_robot_from_config(config.inner_config)
        self.servos = make_guarded_servos(config.settings, tuple(robot.action_features))
        check_configuration(robot, self.servos.servos.keys, config.units)
        self.inner = InnerRobot(robot)
        self.bus = BusThread(self.servos, self.inner.positions, self.inner.write)
        self.inner.allow_only(self.bus)

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        """Those of the inner robot, and the mark of interventions if it is recorded."""
        mark = {INTERVENTION: float} if self.config.mark_interventions else {}
        return {**self.inner.robot.observation_features, **mark}

    @cached_property
    def action_features(self) -> dict[str, Any]:
        """Those of the inner robot."""
        return self.inner.robot.action_features

    @property
    def cameras(self) -> dict[str, Any]:
        """Those of the inner robot."""
        return getattr(self.inner.robot, "cameras", {})

    @property
    def is_connected(self) -> bool:
        """Whether the inner robot is connected."""
        return self.inner.robot.is_connected

    @property
    def is_calibrated(self) -> bool:
        """Whether the inner robot is calibrated."""
        return self.inner.robot.is_calibrated

    @property
    def state(self) -> ServoState:
        """What the guard did since the last action began: values written, whether it intervened, and problems."""
        return self.bus.state

    def connect(self, calibrate: bool = True) -> None:
        """Connect the inner robot, compare its readings with the robot model, and start the thread.

        After every error behind the connection, the inner robot is disconnected again.

        Raises:
            ConfigurationError: a joint reads a position outside of its range: another calibration or another model.
        """
        self.inner.robot.connect(calibrate)
        try:
            self.servos.check_range(self.inner.positions())
            self.bus.start(self.inner.commanded())
        except BaseException as error:
            self._disconnect_after(error)
            raise

    def calibrate(self) -> None:
        """Calibrate the inner robot; the thread must not run."""
        self._require_stopped("calibration")
        self.inner.robot.calibrate()

    def configure(self) -> None:
        """Configure the inner robot, which may switch its torque off; the thread must not run."""
        self._require_stopped("configuration")
        self.inner.robot.configure()

    def _require_stopped(self, purpose: str) -> None:
        if self.bus.is_running:
            raise ConfigurationError.stating("The bus thread runs.", fix=f"Disconnect before the {purpose}.")

    def get_observation(self) -> dict[str, Any]:
        """The observation of the inner robot, with the mark of interventions if it is recorded."""
        found = self.inner.observation()
        if self.config.mark_interventions:
            found[INTERVENTION] = float(self.bus.take_intervention())
        return found

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Make `action` the newest goal of the thread and return the values that it has written after that.

        Before the first usable action nothing is written, and the positions that the servos have are returned.
        """
        state = self.bus.send(action)
        here = self.bus.reading
        present = {key: here[key] for key in self.action_features if key in here}
        return {**present, **state.written}

    def _disconnect_after(self, error: BaseException) -> None:
        """Disconnect after `error`, which gets a note if that fails: the servos may then hold their position."""
        try:
            self.disconnect()
        except Exception as second:  # the first error is the one to report
            error.add_note(f"{self.inner.robot.name} was not disconnected: {second}. Switch the power of the arm off.")

    def disconnect(self) -> None:
        """Stop the thread and disconnect the inner robot."""
        self.bus.stop()
        self.inner.robot.disconnect()
