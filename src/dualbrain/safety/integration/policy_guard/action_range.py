"""Check of the bounds of an environment's actions: an environment that clips a safe action makes it another one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError
from dualbrain.robots.model import RobotModel
from dualbrain.safety.integration.policy_guard.action_space import ROUNDING, ActionSpace
from dualbrain.safety.integration.policy_guard.joint_actions import JointPosition, JointVelocity

Array = NDArray[np.float64]

UNBOUNDED = 1e6
"""Entry of an action in place of an infinite bound."""
OTHER_UNITS = (
    "State the units of the actions (`decode_action` and `encode_action`, or the layout of the action space), or build "
    "the filter for `derate(..., max_speed=...)`."
)
NARROWER_JOINTS = (
    "State the units of the actions by the layout of the action space, or narrow the joint limits of the robot model."
)


@dataclass(frozen=True, slots=True, kw_only=True)
class _RequiredRange:
    """The values `low` to `high` (n,), in SI units, that a safe action may have."""

    name: str
    low: Array
    high: Array
    fix: str


def check_action_range(
    bounds: Any, space: ActionSpace, robot_model: RobotModel, step_time: float, *, fix: str = ""
) -> None:
    """Refuse `bounds`, the action space of an environment, if they are narrower than the safe actions of `space`.

    Joint velocities need ±v_max, joint positions the range of every joint, and relative ones ±v_max times `step_time`
    [s], the time of one action. Bounds without `low` and `high`, and the actions of all other spaces, are not checked.
    `fix` replaces the remedy of the error.

    Raises:
        ConfigurationError: the bounds are narrower, or `space` cannot read them.
    """
    required = _required_range(space, robot_model, step_time)
    if required is None or not (hasattr(bounds, "low") and hasattr(bounds, "high")):
        return
    first, second = (_values(bound, space, robot_model.n, required) for bound in (bounds.low, bounds.high))
    low, high = np.minimum(first, second), np.maximum(first, second)
    slack = ROUNDING * (required.high - required.low)
    if np.any(low > required.low + slack) or np.any(high < required.high - slack):
        raise ConfigurationError(
            f"{required.name} in the action space",
            got=[low.tolist(), high.tolist()],
            allowed=f"{required.low.tolist()} to {required.high.tolist()} or more, because a safe action must not be "
            "clipped",
            fix=fix or required.fix,
        )


def _required_range(space: ActionSpace, robot_model: RobotModel, step_time: float) -> _RequiredRange | None:
    v_max = np.array([joint.velocity.value for joint in robot_model.joints])
    if isinstance(space, JointVelocity):
        return _RequiredRange(name="joint velocities [rad/s]", low=-v_max, high=v_max, fix=OTHER_UNITS)
    if not isinstance(space, JointPosition):
        return None
    if space.delta:
        way = v_max * step_time
        return _RequiredRange(name="changes of the joint positions [rad]", low=-way, high=way, fix=OTHER_UNITS)
    return _RequiredRange(
        name="joint positions [rad]",
        low=np.array([joint.lower.value for joint in robot_model.joints]),
        high=np.array([joint.upper.value for joint in robot_model.joints]),
        fix=NARROWER_JOINTS,
    )


def _values(bound: Any, space: ActionSpace, n: int, required: _RequiredRange) -> Array:
    """The values (n,) in SI units of one corner of the action space."""
    corner = np.clip(np.asarray(bound), -UNBOUNDED, UNBOUNDED)
    found = space.layout.read(corner, space.count(n), None)
    if isinstance(found, str) or found.shape != (n,):
        problem = found if isinstance(found, str) else f"{len(found)} values"
        raise ConfigurationError(
            f"{required.name} in the action space", got=problem, allowed=f"{n} numbers", fix=required.fix
        )
    return found
