"""Configuration of the guarded robot."""

from dataclasses import dataclass, field
from typing import Any, Literal

import draccus
from lerobot.robots import RobotConfig

from dualbrain.errors import ConfigurationError
from dualbrain.safety.integration.servo_bus.servo_map import ServoCalibration
from dualbrain.safety.integration.servo_bus.servo_settings import ServoSettings


@RobotConfig.register_subclass("dualbrain_guarded")
@dataclass(kw_only=True)
class DualbrainGuardedConfig(RobotConfig):
    """The `inner` robot that is guarded, and the settings of its guard (`ServoSettings`).

    `inner` is its configuration as a mapping, {"type": "so101_follower", "port": …}: LeRobot's command lines cannot
    nest the options of one robot in those of another. In Python it may also be a `RobotConfig`.
    `units` states that a robot whose units are not known takes degrees. `mark_interventions` adds the entry
    `intervention` to the observation: 1 if the guard changed the motion since the last observation, else 0.
    """

    inner: dict[str, Any]
    model: str = "so101"
    site: str = ""
    rate: float = 200.0
    action_rate: float = 30.0
    calibration: dict[str, ServoCalibration] = field(default_factory=dict)
    digest: str = ""
    deviation: Literal["nearest", "along_path"] = "nearest"
    units: Literal["", "degrees"] = ""
    mark_interventions: bool = False

    @property
    def inner_config(self) -> RobotConfig:
        """The configuration of the inner robot.

        Raises:
            ConfigurationError: it has no known type, or an option that its type does not have.
        """
        if isinstance(self.inner, RobotConfig):
            return self.inner
        try:
            return draccus.decode(RobotConfig, self.inner)
        except Exception as error:  # whatever the parser raises
            raise ConfigurationError.stating(
                f"The configuration of the inner robot cannot be used: {error}.",
                fix="State type and options: `--robot.inner='{type: so101_follower, port: /dev/ttyACM0}'`.",
            ) from error

    @property
    def settings(self) -> ServoSettings:
        """The settings of the guard."""
        calibration = {
            name: ServoCalibration(**entry) if isinstance(entry, dict) else entry
            for name, entry in self.calibration.items()
        }
        return ServoSettings(
            model=self.model,
            site=self.site,
            rate=self.rate,
            action_rate=self.action_rate,
            calibration=calibration,
            digest=self.digest,
            deviation=self.deviation,
        )
