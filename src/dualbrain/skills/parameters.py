"""The parameters that motion skills share, bounded by the body and saying where each bound comes from (design 3)."""

from __future__ import annotations

from dualbrain.contracts.skill_spec import ChoiceParameter, NumberParameter
from dualbrain.robots.model import RobotModel

CONTACT_SPEED = 0.05
"""How fast the fingers or a held thing may approach what they are allowed to touch [m/s]."""


def speed(robot_model: RobotModel) -> NumberParameter:
    """Tool speed on the way [m/s]."""
    return NumberParameter(
        "speed", "m/s", 0.05, robot_model.tool_speed.value, "slower wastes time without safety", robot_model.tool_speed.provenance,
        "tool speed on the way",
    )  # fmt: skip


def clearance() -> NumberParameter:
    """Height of the lowest carried point (or of the finger tips) above the support while travelling [m]."""
    return NumberParameter(
        "clearance", "m", 0.03, 0.35, "site policy: nothing is dragged", "reach of the arm over the table",
        "height of the lowest carried point above the support on the way",
    )  # fmt: skip


def route() -> ChoiceParameter:
    """Which way round to travel."""
    return ChoiceParameter(
        "route", ("direct", "near_base", "left", "right"), "way round: straight, close to the base, or bent aside"
    )


def wait() -> ChoiceParameter:
    """Whether to start only when people are clear of the path."""
    return ChoiceParameter("wait", ("none", "until_clear"), "until_clear: start only when no person crosses the path")


def force(robot_model: RobotModel) -> NumberParameter:
    """Grip force [N]."""
    low, high = robot_model.gripper.force_min, robot_model.gripper.force
    return NumberParameter("force", "N", low.value, high.value, low.provenance, high.provenance, "grip force")


def opening(robot_model: RobotModel) -> NumberParameter:
    """Distance between the fingers before the grasp [m]."""
    limit = robot_model.gripper.opening
    return NumberParameter(
        "opening", "m", 0.02, 2.0 * limit.value, "narrower than any graspable thing", f"twice {limit.provenance}",
        "distance between the fingers before the grasp",
    )  # fmt: skip


def max_speed(robot_model: RobotModel) -> NumberParameter:
    """Speed of a base on its way [m/s]."""
    limit = robot_model.joints[0].velocity
    return NumberParameter(
        "max_speed", "m/s", 0.1, limit.value, "slower wastes time without safety", limit.provenance, "speed on the way"
    )


def max_turn_rate(robot_model: RobotModel) -> NumberParameter:
    """Turn rate of a base [rad/s]."""
    limit = robot_model.joints[1].velocity
    return NumberParameter(
        "max_turn_rate", "rad/s", 0.2, limit.value, "slower wastes time without safety", limit.provenance,
        "turn rate on the way",
    )  # fmt: skip


def heading() -> NumberParameter:
    """Heading on the map [rad]."""
    turn = "half a turn either way"
    return NumberParameter(
        "heading", "rad", -3.1416, 3.1416, turn, turn, "0 looks along the map's x, counter-clockwise"
    )
