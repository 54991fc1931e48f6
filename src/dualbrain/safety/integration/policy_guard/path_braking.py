"""Braking along the path of a policy: the fastest control in the commanded direction that the filter does not change.

Of the controls c(s) = clip(s u_nom, u_prev ± a dt), 0 ≤ s ≤ 1, the one with the largest s is chosen that every barrier
admits. The clip keeps the acceleration limits a; the direction deviates only as far as they need it. A learned policy
then sees states on its own path, later than it expects. The filter still checks the chosen control, so the guarantee is
the same. If none is admitted, for example because an obstacle approaches, the arm deviates from the path.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.filter import SafetyFilter

Array = NDArray[np.float64]

COARSE, FINE = 17, 9
"""Number of controls that are compared in the first and in the second pass."""
ROUNDING = 0.999
"""Share of the acceleration limits that the clip uses; the rest is for rounding of the kernel."""
UNCHANGED = 1e-6
"""Largest delta of a control that the filter does not change."""


def braking_step(robot_model: RobotModel) -> Array:
    """The largest change of the control (n,) [rad/s] in one period that the clip admits."""
    limits = np.array([joint.acceleration.value for joint in robot_model.joints])
    return ROUNDING * robot_model.period * limits


def brake_along_path(
    safety: SafetyFilter,
    step: Array,
    q: Array,
    v: Array,
    u_nom: Array,
    u_prev: Array,
    now: float,
    opening: float | None,
) -> tuple[Array, float] | None:
    """The admitted control (n,) [rad/s] with the largest share s of `u_nom`, and s; None if no control is admitted.

    `step` (n,) is `braking_step`; `q`, `v` (n,) are the joint state, `u_prev` (n,) is the last control, `now` [s] and
    `opening` [m] are as for `SafetyFilter`.
    """
    low, high = u_prev - step, u_prev + step

    def admitted(shares: Array) -> tuple[Array, NDArray[np.bool_]]:
        controls, ones = np.clip(shares[:, None] * u_nom, low, high), np.ones((len(shares), 1))
        result = safety.batch(ones * q, ones * v, controls, now, u_prev=ones * u_prev, opening=opening)
        return controls, result.delta <= UNCHANGED

    shares: Array = np.linspace(1.0, 0.0, COARSE)
    controls, good = admitted(shares)
    if not good.any():
        return None
    best = int(np.argmax(good))
    if best == 0:
        return controls[0], 1.0
    shares = np.linspace(float(shares[best - 1]), float(shares[best]), FINE)
    controls, good = admitted(shares)
    best = int(np.argmax(good))  # the last one was admitted in the first pass
    return controls[best], float(shares[best])
