"""Configuration of the safety filter. The experiments in the tests use the default values."""

from __future__ import annotations

from typing import Literal

import msgspec


class FilterConfig(msgspec.Struct, frozen=True, kw_only=True):
    """Configuration of the safety filter. Lengths are in m, times in s, gains in 1/s, speeds in m/s.

    - `alpha`: class-K gain, ḣ ≥ −α h. None selects the largest gain that the acceleration limits can follow,
      min_i a_i / v_i. `alpha_self` and `alpha_joint` override it for self-collision and for joint limits.
    - `recovery_speed`: largest ḣ that a violated row asks for.
    - `sampling_margin`: margin of rows beyond h = 0, so that a step of finite length ends at h ≥ 0.
    - `rounding_margin`: margin for float32 rounding (in rad for joint limits).
    - `self_margin`: clearance between links of the robot.
    - `projection_margin`: clearance of the projection φ in addition to that of the filter.
    - `tracking_error` [rad/s]: margin per joint for ẏ ≠ u beyond the modelled lag. None takes the identified value α e
      of the robot model (`TrackingErrorModel.row_margin`), which does not cover a larger gain of one obstacle.
    - `scene_stale_after`, `state_stale_after`: ages after which moving obstacles and the joint state are rejected.
    - `acceleration_limits`, `jerk_limits`: add these limits of the robot model to the box. Jerk limits are dropped in
      a step in which other limits leave no room for them (`Reason.JERK`).
    - `lag_compensation`: evaluate barriers at y = q + lag·v.
    - `precision`: number type of the kernel.
    """

    alpha: float | None = None
    alpha_self: float | None = None
    alpha_joint: float | None = None
    recovery_speed: float = 0.05
    sampling_margin: float = 2e-4
    rounding_margin: float = 1e-5
    self_margin: float = 0.0
    projection_margin: float = 5e-4
    tracking_error: float | None = None
    scene_stale_after: float = 0.5
    state_stale_after: float = 0.05
    acceleration_limits: bool = True
    jerk_limits: bool = False
    lag_compensation: bool = True
    precision: Literal["float32", "float64"] = "float32"
