"""The guard as a step of a processor pipeline, for programs that call the pipeline themselves.

The commands of LeRobot build their pipelines themselves, and its asynchronous client has none: they need the robot
`dualbrain_guarded`. A step answers once per action and predicts the motion until the next one.
"""

import time
from dataclasses import dataclass, field
from typing import Any, Literal

from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.processor import EnvTransition, ProcessorStepRegistry, RobotActionProcessorStep, TransitionKey
from lerobot.teleoperators.utils import TeleopEvents

from dualbrain.errors import ConfigurationError
from dualbrain.safety.integration.servo_bus.guarded_servos import GuardedServos
from dualbrain.safety.integration.servo_bus.servo_map import ServoCalibration
from dualbrain.safety.integration.servo_bus.servo_settings import ServoSettings, make_guarded_servos


@ProcessorStepRegistry.register("dualbrain_safety_filter")
@dataclass
class DualbrainSafetyFilterStep(RobotActionProcessorStep):
    """Replaces the positions [deg] of an action by safe ones; the observation of the transition has the joints.

    The settings are those of `ServoSettings`, with `calibration` as {joint: {"key", "sign", "offset"}}. The info of the
    transition gets `TeleopEvents.IS_INTERVENTION`.
    """

    model: str = "so101"
    site: str = ""
    rate: float = 200.0
    action_rate: float = 30.0
    calibration: dict[str, dict[str, Any]] = field(default_factory=dict)
    digest: str = ""
    deviation: Literal["nearest", "along_path"] = "nearest"

    def __post_init__(self) -> None:
        """Make the guard with the first action, whose entries name the servos."""
        self._servos: GuardedServos | None = None
        self._is_checked = False

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """The transition with the safe action, and the mark of an intervention in its info."""
        changed = super().__call__(transition)
        state = self._require_servos(changed[TransitionKey.ACTION]).state
        info = dict(changed.get(TransitionKey.INFO) or {})
        info[TeleopEvents.IS_INTERVENTION] = state.intervened
        changed[TransitionKey.INFO] = info
        return changed

    def action(self, action: dict[str, Any]) -> dict[str, Any]:
        """The safe action.

        Raises:
            ConfigurationError: the first action or observation of an episode is unusable, so that there is no command
                to repeat, or that observation has a joint outside of its range: another calibration or another model.
        """
        servos = self._require_servos(action)
        observation = self.transition.get(TransitionKey.OBSERVATION) or {}
        if not self._is_checked:
            servos.check_range(observation)
            self._is_checked = True
        written = servos(action, observation, time.monotonic())
        if not written:
            problem = servos.state.problem or "The first action is unusable"
            raise ConfigurationError.stating(f"{problem}.", fix="No command was sent yet that could be repeated.")
        return {key: written.get(key, value) for key, value in action.items()} | written

    def _require_servos(self, action: dict[str, Any]) -> GuardedServos:
        if self._servos is None:
            calibration = {name: ServoCalibration(**entry) for name, entry in self.calibration.items()}
            settings = ServoSettings(**{**self.get_config(), "calibration": calibration})
            self._servos = make_guarded_servos(settings, tuple(action), predicts=True)
        return self._servos

    def get_config(self) -> dict[str, Any]:
        """What `save_pretrained` writes, so that the folder of a policy can contain the filter."""
        return {
            "model": self.model,
            "site": self.site,
            "rate": self.rate,
            "action_rate": self.action_rate,
            "calibration": self.calibration,
            "digest": self.digest,
            "deviation": self.deviation,
        }

    def reset(self) -> None:
        """Begin an episode: the next action starts from the joints as they are measured then."""
        self._is_checked = False
        if self._servos is not None:
            self._servos.reset()

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """The same names and shapes."""
        return features
