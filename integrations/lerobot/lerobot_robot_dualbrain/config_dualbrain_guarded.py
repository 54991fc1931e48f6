"""Configuration of the guarded robot."""

from dataclasses import dataclass, field
from typing import Literal

from lerobot.robots import RobotConfig

from dualbrain.safety.integration.servo_bus.servo_map import ServoCalibration
from dualbrain.safety.integration.servo_bus.servo_settings import ServoSettings


@RobotConfig.register_subclass("dualbrain_guarded")
@dataclass(kw_only=True)
class DualbrainGuardedConfig(RobotConfig):
    """The `inner` robot that is guarded, and the settings of its guard (`ServoSettings`).

    `units` states that a robot whose units are not known takes degrees. `mark_interventions` adds the entry
    `intervention` to the observation: 1 if the guard changed the motion since the last observation, else 0.
    """

    inner: RobotConfig
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
