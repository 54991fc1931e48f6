"""Parameters that motion skills share, with bounds from the robot model and the origin of each bound (design 3)."""

from __future__ import annotations

from collections.abc import Mapping

from dualbrain.contracts.skill_spec import ChoiceParameter, NumberParameter
from dualbrain.robots.model import RobotModel

CONTACT_SPEED = 0.05
"""Approach speed of the fingers or a held object toward an object that they may touch [m/s]."""

LEVELS: Mapping[str, Mapping[str, float | str]] = {
    "speed": {"slow": 0.1, "normal": 0.2, "fast": 0.35},
    "clearance": {"low": 0.08, "middle": 0.15, "high": 0.3},
    "approach": {"top": "top", "tilted": "tilted"},
    "route": {"direct": "direct", "near_base": "near_base", "left": "left", "right": "right"},
    "wait": {"none": "none", "until_clear": "until_clear"},
    "force": {"firm": 15.0},
    "opening": {"wide": 0.08},
    "distance": {"middle": 0.1},
    "max_speed": {"slow": 0.2, "normal": 0.4, "fast": 0.6},
    "max_turn_rate": {"slow": 0.5, "normal": 1.0, "fast": 1.5},
}
"""Named levels of the open parameters, in the units of each; levels that depend on a scene are those of
`grounding/alternatives.py`."""


def speed(robot_model: RobotModel) -> NumberParameter:
    """Tool speed during motion [m/s]."""
    return NumberParameter(
        name="speed",
        unit="m/s",
        lower=0.05,
        upper=robot_model.tool_speed.value,
        lower_from="slower wastes time without safety",
        upper_from=robot_model.tool_speed.provenance,
        description="tool speed on the way",
    )


def clearance() -> NumberParameter:
    """Height of the lowest carried point (or of the finger tips) above the support while travelling [m]."""
    return NumberParameter(
        name="clearance",
        unit="m",
        lower=0.03,
        upper=0.35,
        lower_from="site policy: nothing is dragged",
        upper_from="reach of the arm over the table",
        description="height of the lowest carried point above the support on the way",
    )


def route() -> ChoiceParameter:
    """Choice of the route."""
    return ChoiceParameter(
        "route", ("direct", "near_base", "left", "right"), "way round: straight, close to the base, or bent aside"
    )


def wait() -> ChoiceParameter:
    """Whether to start only while no person crosses the path."""
    return ChoiceParameter("wait", ("none", "until_clear"), "until_clear: start only when no person crosses the path")


def force(robot_model: RobotModel) -> NumberParameter:
    """Grip force [N]."""
    low, high = robot_model.gripper.force_min, robot_model.gripper.force
    return NumberParameter(
        name="force",
        unit="N",
        lower=low.value,
        upper=high.value,
        lower_from=low.provenance,
        upper_from=high.provenance,
        description="grip force",
    )


def opening(robot_model: RobotModel) -> NumberParameter:
    """Distance between the fingers before the grasp [m]."""
    limit = robot_model.gripper.opening
    return NumberParameter(
        name="opening",
        unit="m",
        lower=0.02,
        upper=2.0 * limit.value,
        lower_from="narrower than any graspable thing",
        upper_from=f"twice {limit.provenance}",
        description="distance between the fingers before the grasp",
    )


def max_speed(robot_model: RobotModel) -> NumberParameter:
    """Speed of a base during motion [m/s]."""
    limit = robot_model.joints[0].velocity
    return NumberParameter(
        name="max_speed",
        unit="m/s",
        lower=0.1,
        upper=limit.value,
        lower_from="slower wastes time without safety",
        upper_from=limit.provenance,
        description="speed on the way",
    )


def max_turn_rate(robot_model: RobotModel) -> NumberParameter:
    """Turn rate of a base [rad/s]."""
    limit = robot_model.joints[1].velocity
    return NumberParameter(
        name="max_turn_rate",
        unit="rad/s",
        lower=0.2,
        upper=limit.value,
        lower_from="slower wastes time without safety",
        upper_from=limit.provenance,
        description="turn rate on the way",
    )


def heading() -> NumberParameter:
    """Heading on the map [rad]."""
    turn = "half a turn either way"
    return NumberParameter(
        name="heading",
        unit="rad",
        lower=-3.1416,
        upper=3.1416,
        lower_from=turn,
        upper_from=turn,
        description="0 looks along the map's x, counter-clockwise",
    )
