"""The home posture of a robot model: within its joint limits, free of self-collision, and clear of the site."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle


def find_home_problem(robot_model: RobotModel, obstacles: Sequence[Obstacle] = ()) -> str:
    """Why `robot_model` must not be brought to its home posture among `obstacles`; "" if it may.

    At rest there every h of the filter must be at least 0: between links, and between links and obstacles. The fingers
    cover every opening.

    Raises:
        GeometryError: an obstacle is not usable.
    """
    if problem := _limit_problem(robot_model):
        return problem
    rest = np.zeros(robot_model.n)
    safety = SafetyFilter(robot_model, FilterConfig(acceleration_limits=False), obstacles=obstacles)
    result = safety(np.array(robot_model.home), rest, rest, 0.0)
    if result.h_min >= 0.0:
        return ""
    return f"in the home posture the smallest h is {result.h_min * 1e3:.1f} mm ({result.limiting_row})"


def _limit_problem(robot_model: RobotModel) -> str:
    """The first joint whose home position is outside of its range; "" if there is none."""
    pose, wheels = (3, 2) if robot_model.is_mobile else (0, 0)  # the pose of a base has no limits
    for joint, home in zip(robot_model.joints[wheels:], robot_model.home[pose:], strict=True):
        low, high = joint.lower.value, joint.upper.value
        if not low <= home <= high:
            return f"{joint.name} has the home position {home:.3f}, and its range is {low:.3f} to {high:.3f}"
    return ""
