"""Settings of a guarded servo arm, and the guarded servos that they describe."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from dualbrain.core.geometry.shapes import HalfSpace
from dualbrain.errors import ConfigurationError
from dualbrain.robots.loader import encode_robot, load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.robots.site_config import read_site
from dualbrain.safety.cbf.config import operating_config
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.integration.derating import derate
from dualbrain.safety.integration.policy_guard.guard import Deviation
from dualbrain.safety.integration.servo_bus.guarded_servos import GuardedServos
from dualbrain.safety.integration.servo_bus.servo_map import ServoCalibration, ServoMap
from dualbrain.safety.integration.site import site_obstacles, site_robot

MIN_RATE, MAX_RATE = 100.0, 1000.0
"""Bounds of the rate of the bus [1/s]."""
MIN_DIGEST = 8
"""Fewest hexadecimal digits of a digest."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoSettings:
    """What a guarded servo arm needs.

    `model`: a packaged robot, or the folder of an imported one. `site`: a site file (TOML) with planes, keep-out boxes
    and limits; "" is a table, the plane z = 0 in the frame of the base. A control period in it is not used. `rate`
    [1/s] of the bus, `action_rate` [1/s] of the policy. `calibration` by joint. `digest`: the beginning of the expected
    `model_digest`, "" for any.
    """

    model: str
    site: str = ""
    rate: float = 200.0
    action_rate: float = 30.0
    calibration: Mapping[str, ServoCalibration] = field(default_factory=dict[str, ServoCalibration])
    digest: str = ""
    deviation: Deviation = "nearest"


def make_guarded_servos(settings: ServoSettings, keys: Sequence[str], *, predicts: bool = False) -> GuardedServos:
    """The guarded servos of an arm whose actions have the entries `keys` ("shoulder_pan.pos", …, "gripper.pos").

    `predicts`: for a loop without a bus, which calls the servos once per action.

    Raises:
        UnknownNameError, ConfigurationError: a setting cannot be used, the robot model is another one than expected,
            its tracking error was not identified, or its joints do not fit the servos.
    """
    _check_rates(settings)
    robot_model = load_robot(settings.model)
    check_digest(robot_model, settings.digest)
    safety = make_filter(derate(robot_model, period=1.0 / settings.rate), settings.site)
    servos = ServoMap.of(safety.robot_model, keys, calibration=settings.calibration)
    period = 1.0 / settings.action_rate
    return GuardedServos(safety, servos, action_period=period, deviation=settings.deviation, predicts=predicts)


def model_digest(robot_model: RobotModel) -> str:
    """The SHA-256 of the robot model, 64 hexadecimal digits: it changes with every number of the model."""
    return hashlib.sha256(encode_robot(robot_model)).hexdigest()


def check_digest(robot_model: RobotModel, expected: str) -> None:
    """Raise `ConfigurationError` if the digest of `robot_model` does not begin with `expected`."""
    found = model_digest(robot_model)
    if expected and not (len(expected) >= MIN_DIGEST and found.startswith(expected.lower())):
        raise ConfigurationError.stating(
            f"The model of {robot_model.name} has the digest {found[:12]}, expected is {expected[:64]!r}.",
            fix="Use the robot model that was checked with this arm, or check this one and state its digest "
            f"(at least {MIN_DIGEST} digits).",
        )


def make_filter(robot_model: RobotModel, site: str) -> SafetyFilter:
    """The filter of `robot_model` at the site file `site`; without one ("") above a table, the plane z = 0 of the base.

    The period stays that of `robot_model`: the bus or the loop runs at it.

    Raises:
        ConfigurationError: the site file cannot be used, or has no plane and no keep-out box.
    """
    if not site:
        table = Obstacle("table", HalfSpace())
        return SafetyFilter(robot_model, operating_config(robot_model), obstacles=[table])
    file = read_site(site)
    narrowed = derate(site_robot(robot_model, file), period=robot_model.period)
    obstacles = site_obstacles(narrowed, file)
    if not obstacles:
        raise ConfigurationError.stating(
            f"The site file {site} has no plane and no keep-out box: not even the table would be protected.",
            fix='Add at least one [[plane]], for example name = "table", point = [0, 0, 0], inward = [0, 0, 1].',
        )
    return SafetyFilter(narrowed, operating_config(narrowed), obstacles=obstacles)


def _check_rates(settings: ServoSettings) -> None:
    if not MIN_RATE <= settings.rate <= MAX_RATE:
        allowed = f"{MIN_RATE:g} to {MAX_RATE:g}"
        raise ConfigurationError("rate of the servo bus [1/s]", got=settings.rate, allowed=allowed)
    if not 0.5 <= settings.action_rate <= settings.rate:
        allowed = f"0.5 to the rate of the bus, {settings.rate:g}"
        raise ConfigurationError("rate of the actions [1/s]", got=settings.action_rate, allowed=allowed)
