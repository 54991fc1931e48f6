"""Classes of the experiment `adversary`: the errors in the loop, their bounds, and the filter configured for them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import msgspec

from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.obstacles import Obstacle

PERIOD, ALPHA = 1e-3, 7.5 / 2.175
OBSTACLE_POSITION_NOISE, OBSTACLE_SPEED_NOISE = 0.005, 0.02
"""Error norms of perceived obstacles [m, m/s]."""
JOINT_POSITION_NOISE, JOINT_SPEED_NOISE = 2e-4, 0.01
"""Error bounds of measured joints [rad, rad/s]."""
PANDA = load_robot("panda")
LAG, POSITION_ERROR = PANDA.tracking.lag, max(PANDA.tracking.position_errors(PANDA.n))
"""Lag [s] and leaky integral of the tracking residual [rad], as identified for the robot's own drive."""
MAX_DISTURBANCE = ALPHA * POSITION_ERROR
"""The worst disturbance ydot − u within these bounds, constant and against the nearest row [rad/s]."""
MAX_STATE_LOSS_PERIODS = 20
"""Largest number of joint states lost in a row; the caller integrates the controls sent since the last state."""
MOVING_OBSTACLE_SPEED, MOVING_OBSTACLE_ACCELERATION = 0.25, 1.0
CAMERA_PERIODS, MAX_SCENE_AGE_PERIODS = 20, 80
"""Camera period and largest age of a scene [control periods]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AdversaryClass:
    """One documented configuration: the error bounds in the loop, and the filter configured for them."""

    name: str
    description: str
    loop_settings: dict[str, Any]
    filter_settings: dict[str, Any]
    margin: float = 0.0
    """Margin of perceived obstacles [m]."""
    has_moving_obstacle: bool = False
    speed_only: bool = False
    """The filter knows only the greatest speed of a moving obstacle, in any direction at any time."""
    compared_with: str = ""
    """For a negative control: the complete class, which holds."""
    is_covered: bool = False
    """For a control: another element of the filter covers the removed one, so that the class still holds."""

    def filter_config(self) -> FilterConfig:
        """The filter's configuration."""
        return FilterConfig(**self.filter_settings)

    def trial_parameters(self, seed: int, steps: int) -> dict[str, Any]:
        """The parameters of the kernel's worst-case loop."""
        return {**UNDISTURBED, **self.loop_settings, "seed": seed, "steps": steps, "hold": (150, 400, 1000)[seed % 3]}

    def perceived_obstacle(self, obstacle: Obstacle) -> Obstacle:
        """A true obstacle with the error bounds that the filter assumes."""
        loop = {**UNDISTURBED, **self.loop_settings}
        changed = loop["speed_noise"] + loop["mover_acceleration"] * MAX_SCENE_AGE_PERIODS * PERIOD
        error = loop["mover_speed"] if self.speed_only else changed * loop["velocity_share"]
        return msgspec.structs.replace(obstacle, margin=self.margin, velocity_error=0.0 if obstacle.static else error)


def position_error(loop: dict[str, Any]) -> float:
    """The position error that the rows must tolerate [rad].

    It is the measurement error, and the leaky integral of the disturbance, also while no new states arrive.
    """
    measured = loop["q_noise"] + LAG * loop["v_noise"]
    return measured + loop["push"] * (1.0 / ALPHA + loop["state_longest"] * PERIOD)


UNDISTURBED: dict[str, Any] = {
    "toward": 0.9,
    "lag": 0.0,
    "push": 0.0,
    "q_noise": 0.0,
    "v_noise": 0.0,
    "place_noise": 0.0,
    "speed_noise": 0.0,
    "frame": CAMERA_PERIODS,
    "scene_longest": MAX_SCENE_AGE_PERIODS,
    "state_longest": 0,
    "dead_reckoning": 1,
    "scene_drop": 0.0,
    "state_drop": 0.0,
    "late": 0.0,
    "velocity_share": 1.0,
    "mover_speed": MOVING_OBSTACLE_SPEED,
    "mover_acceleration": MOVING_OBSTACLE_ACCELERATION,
    "clearance": 0.01,
    "evadable": 1,
}
PLANT_ERRORS = {"lag": LAG, "push": MAX_DISTURBANCE}
SENSOR_NOISE = {
    **PLANT_ERRORS,
    "q_noise": JOINT_POSITION_NOISE,
    "v_noise": JOINT_SPEED_NOISE,
    "place_noise": OBSTACLE_POSITION_NOISE,
    "speed_noise": OBSTACLE_SPEED_NOISE,
}
MESSAGE_LOSS = {"state_longest": MAX_STATE_LOSS_PERIODS, "state_drop": 0.01, "scene_drop": 0.3}
ALL_ERRORS = {**SENSOR_NOISE, **MESSAGE_LOSS}
EXACT_FILTER = {"lag_compensation": False, "tracking_error": 0.0}


def _filter_settings_for(loop: dict[str, Any]) -> dict[str, Any]:
    return {"tracking_error": ALPHA * position_error({**UNDISTURBED, **loop})}


STATIC_CLASSES = (
    AdversaryClass(
        name="exact",
        description="none: q integrates u, all measurements are exact",
        loop_settings={},
        filter_settings=EXACT_FILTER,
    ),
    AdversaryClass(
        name="plant",
        description="lag and the worst tracking disturbance",
        loop_settings=PLANT_ERRORS,
        filter_settings=_filter_settings_for(PLANT_ERRORS),
    ),
    AdversaryClass(
        name="noise",
        description="as plant, with joints and obstacles measured at their error bounds",
        loop_settings=SENSOR_NOISE,
        filter_settings=_filter_settings_for(SENSOR_NOISE),
        margin=OBSTACLE_POSITION_NOISE,
    ),
    AdversaryClass(
        name="drops",
        description="as noise, with lost joint states and scenes",
        loop_settings=ALL_ERRORS,
        filter_settings=_filter_settings_for(ALL_ERRORS),
        margin=OBSTACLE_POSITION_NOISE,
    ),
    AdversaryClass(
        name="stale",
        description="as drops, with joint states up to 50 ms old used without dead reckoning",
        loop_settings={**ALL_ERRORS, "state_longest": 49, "dead_reckoning": 0},
        filter_settings=_filter_settings_for(ALL_ERRORS),
        margin=OBSTACLE_POSITION_NOISE,
    ),
    AdversaryClass(
        name="late",
        description="as drops, with missed control periods",
        loop_settings={**ALL_ERRORS, "late": 0.002},
        filter_settings=_filter_settings_for(ALL_ERRORS),
        margin=OBSTACLE_POSITION_NOISE,
    ),
)
FAST_OBSTACLE = {**ALL_ERRORS, "evadable": 0, "mover_speed": 0.8, "mover_acceleration": 4.0}
MOVING_CLASSES = (
    AdversaryClass(
        name="evadable",
        description="a moving obstacle that leaves an escape",
        loop_settings=ALL_ERRORS,
        filter_settings=_filter_settings_for(ALL_ERRORS),
        margin=OBSTACLE_POSITION_NOISE,
        has_moving_obstacle=True,
    ),
    AdversaryClass(
        name="unevadable",
        description="a fast moving obstacle that leaves no escape if it can; the filter knows its velocity",
        loop_settings=FAST_OBSTACLE,
        filter_settings=_filter_settings_for(ALL_ERRORS),
        margin=OBSTACLE_POSITION_NOISE,
        has_moving_obstacle=True,
    ),
    AdversaryClass(
        name="person",
        description="the same; the filter knows only its greatest speed",
        loop_settings={**FAST_OBSTACLE, "velocity_share": 0.0},
        filter_settings=_filter_settings_for(ALL_ERRORS),
        margin=OBSTACLE_POSITION_NOISE,
        has_moving_obstacle=True,
        speed_only=True,
    ),
)
NEGATIVE_CONTROLS = (
    replace(
        STATIC_CLASSES[2],
        name="no margin",
        description="noise, with a filter that assumes none",
        filter_settings=EXACT_FILTER,
        margin=0.0,
        compared_with="noise",
    ),
    replace(
        STATIC_CLASSES[0],
        name="alpha 10",
        description="exact, with alpha too large for the acceleration limits; the distance of a stop covers it",
        filter_settings={**EXACT_FILTER, "alpha": 10.0},
        compared_with="exact",
        is_covered=True,
    ),
    replace(
        MOVING_CLASSES[0],
        name="no hdot",
        description="the filter does not know the moving obstacle's velocity",
        loop_settings={**ALL_ERRORS, "velocity_share": 0.0},
        compared_with="evadable",
    ),
)
CLASSES = {c.name: c for c in (*STATIC_CLASSES, *MOVING_CLASSES, *NEGATIVE_CONTROLS)}
