"""Configuration of the safety filter. The experiments in the tests use the default values."""

from __future__ import annotations

from typing import Literal

import msgspec

from dualbrain.core.geometry.validation import check_flag, check_length, check_number, check_positive
from dualbrain.errors import GeometryError
from dualbrain.robots.model import RobotModel

MAX_GAIN = 1e6
"""Largest gain [1/s]."""
MAX_MARGIN = 1.0
"""Largest margin of the configuration [m]."""
MAX_RATE = 100.0
"""Largest recovery speed [m/s] and tracking error [rad/s]."""
MAX_AGE = 3600.0
"""Largest age [s] up to which an observation can count as fresh."""
MIN_CARTESIAN_SPEED, MAX_CARTESIAN_SPEED = 1e-3, 100.0
"""Bounds of the limit of the Cartesian speed [m/s]. The rounding of the kernel is far below the smaller one."""
PRECISIONS = ("float32", "float64")


class FilterConfig(msgspec.Struct, frozen=True, kw_only=True):
    """Configuration of the safety filter. Lengths are in m, times in s, gains in 1/s, speeds in m/s.

    - `alpha`: class-K gain, ḣ ≥ −α h. The rows of bodies are stricter where the robot could not stop on its arc
      otherwise, see docs/reference/safety/barriers.md. None selects the largest gain that the acceleration limits can
      follow, min_i a_i / v_i. `alpha_self` and `alpha_joint` override it for self-collision and for joint limits.
    - `recovery_speed`: largest ḣ that a violated row asks for.
    - `sampling_margin`: margin of rows beyond h = 0, so that a step of finite length ends at h ≥ 0.
    - `rounding_margin`: margin for float32 rounding (in rad for joint limits).
    - `self_margin`: clearance between links of the robot.
    - `projection_margin`: clearance of the projection φ in addition to that of the filter.
    - `tracking_error` [rad/s]: margin of every joint, or of each joint, for ẏ ≠ u beyond the modelled lag. None takes
      the identified value α e of the robot model (`TrackingErrorModel.row_margins`), which does not cover a larger gain
      of one obstacle.
    - `scene_stale_after`, `state_stale_after`: ages after which moving obstacles and the joint state are rejected.
    - `acceleration_limits`, `jerk_limits`: add these limits of the robot model to the box. With jerk limits a joint
      begins to brake before its position and velocity limits early enough for the ramp of its deceleration. Jerk limits
      are dropped only in a step from which a joint would pass its position limit otherwise (`Reason.JERK`).
    - `lag_compensation`: evaluate barriers at y = q + lag·v.
    - `cartesian_speed`: limit of the speed [m/s] of the tool and of the centre of every collision sphere, also of a
      grasped object. None: no limit. It holds for the returned control in every step without `Reason.OVERSPEED`, also
      while the robot evades a person or stops: of two limits that no control can keep together, the speed limit has
      priority over the obstacle, and the box of joint limits over the speed limit.
    - `precision`: number type of the kernel.

    Raises `GeometryError` for a value of another type, below zero, not finite, or beyond `MAX_GAIN` (gains),
    `MAX_MARGIN` (margins), `MAX_RATE` (recovery speed, tracking error) or `MAX_AGE` (ages).
    """

    alpha: float | None = None
    alpha_self: float | None = None
    alpha_joint: float | None = None
    recovery_speed: float = 0.05
    sampling_margin: float = 2e-4
    rounding_margin: float = 1e-5
    self_margin: float = 0.0
    projection_margin: float = 5e-4
    tracking_error: float | tuple[float, ...] | None = None
    scene_stale_after: float = 0.5
    state_stale_after: float = 0.05
    acceleration_limits: bool = True
    jerk_limits: bool = False
    lag_compensation: bool = True
    cartesian_speed: float | None = None
    precision: Literal["float32", "float64"] = "float32"

    def __post_init__(self) -> None:
        """Check every field, also of a configuration that `msgspec.structs.replace` makes."""
        for name in ("alpha", "alpha_self", "alpha_joint"):
            if (gain := getattr(self, name)) is not None:
                check_positive(f"FilterConfig.{name} [1/s]", gain, MAX_GAIN)
        for name in ("sampling_margin", "rounding_margin", "self_margin", "projection_margin"):
            check_length(f"FilterConfig.{name} [m]", getattr(self, name), MAX_MARGIN)
        check_length("FilterConfig.recovery_speed [m/s]", self.recovery_speed, MAX_RATE)
        self._check_tracking_error()
        if self.cartesian_speed is not None:
            check_number(
                "FilterConfig.cartesian_speed [m/s]", self.cartesian_speed, MIN_CARTESIAN_SPEED, MAX_CARTESIAN_SPEED
            )
        for name in ("scene_stale_after", "state_stale_after"):
            check_length(f"FilterConfig.{name} [s]", getattr(self, name), MAX_AGE)
        for name in ("acceleration_limits", "jerk_limits", "lag_compensation"):
            check_flag(f"FilterConfig.{name}", getattr(self, name))
        precision: object = getattr(self, "precision")  # noqa: B009  (a caller may give any type)
        if not (isinstance(precision, str) and precision in PRECISIONS):
            raise GeometryError("FilterConfig.precision", got=self.precision, allowed=" or ".join(PRECISIONS))

    def _check_tracking_error(self) -> None:
        name, given = "FilterConfig.tracking_error [rad/s]", self.tracking_error
        if isinstance(given, tuple) and not given:
            raise GeometryError(name, got="no number", allowed="one for all joints, or one for each joint")
        for margin in given if isinstance(given, tuple) else () if given is None else (given,):
            check_length(name, margin, MAX_RATE)


def operating_config(robot_model: RobotModel, *, jerk_limits: bool = False) -> FilterConfig:
    """The configuration with which a robot is operated: the Cartesian speed is limited to `RobotModel.tool_speed`.

    The limit of a mobile manipulator is relative to the mount of its arm. A base without an arm has no such limit,
    because the bounds of its control are those of its speed and turn rate.
    """
    limited = robot_model.is_mobile_manipulator or not robot_model.is_mobile
    speed = robot_model.tool_speed.value if limited else None
    return FilterConfig(cartesian_speed=speed, jerk_limits=jerk_limits)
