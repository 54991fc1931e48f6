"""What may be chosen about the filter; every value has a default that the proofs in the tests were run with."""

from __future__ import annotations

from typing import Literal

import msgspec


class FilterConfig(msgspec.Struct, frozen=True, kw_only=True):
    """The dials of the safety filter. Lengths in m, times in s, rates in 1/s, speeds in m/s.

    `alpha` is the class-K gain, ḣ ≥ −α h; None takes the largest that the acceleration limits can follow,
    min_i a_i / v_i. `alpha_self` and `alpha_joint` are the gains of self-collision and of joint limits, where they
    should differ. `recovery_speed` bounds how fast a violated row asks to be left. `sampling_margin` is what rows keep
    beyond h = 0 so that a step of finite length ends at h ≥ 0; `rounding_margin` covers float32 (in rad for joint
    limits). `self_margin` is the clearance between the robot's own parts, `projection_margin` what φ's projection keeps
    beyond the filter. `tracking_error` [rad/s] is what rows keep for ẏ ≠ u, per joint, beyond the body's lag; None
    takes what was identified on the body, α e (`Tracking.budget`; an obstacle's own gain above the filter's is not
    counted). `stale_after` and `state_stale_after` are the ages at which moving obstacles and the joint state are no
    longer believed. `jerk_limits` adds the body's jerk limits to the box; where another limit leaves no room for them
    they yield (`Reason.JERK`).
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
