"""Assembly of the node's core from its parameters: robot model, site, obstacles, filter and description check."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dualbrain.drivers.ros2.command_filter import CommandFilter
from dualbrain.drivers.ros2.joint_order import JointOrder
from dualbrain.drivers.ros2.parameters import NodeParameters
from dualbrain.drivers.ros2.robot_description import DescriptionCheck, source_digest
from dualbrain.errors import ConfigurationError
from dualbrain.robots.loader import BUILTIN_ROBOTS, load_robot
from dualbrain.robots.site_config import read_site
from dualbrain.safety.cbf.config import operating_config
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.integration.derating import derate
from dualbrain.safety.integration.policy_guard.tracking_margin import check_tracking_margin
from dualbrain.safety.integration.site import site_obstacles, site_robot


def make_filter(robot: str, site_file: Path | None, period: float, obstacles: Sequence[Obstacle] = ()) -> SafetyFilter:
    """The filter of `robot` at `period` [s], with the planes and boxes of the site and `obstacles` as obstacles.

    Raises:
        ConfigurationError: a file or a value is not usable, the tracking error of the robot is not identified, there is
            no obstacle at all, or one moves, because nothing observes it.
        UnknownNameError: there is no such robot.
    """
    robot_model = load_robot(robot)
    site = read_site(site_file) if site_file else None
    robot_model = derate(site_robot(robot_model, site) if site else robot_model, period=period)
    everything = (*(site_obstacles(robot_model, site) if site else ()), *obstacles)
    if moving := [obstacle.name for obstacle in everything if obstacle.moves]:
        raise ConfigurationError.stating(
            f"{moving[0]} moves, and nothing observes it in ROS.",
            fix="Leave it out of the scene, or declare the space that it may occupy as a keep_out box of the site.",
        )
    if not everything:
        raise ConfigurationError.stating(
            "There is no obstacle: not even the table or floor would be protected.",
            fix="Give a site file with at least one [[plane]] (`site`), or a scene (`--scene`).",
        )
    config = operating_config(robot_model)
    check_tracking_margin(robot_model, config)
    return SafetyFilter(robot_model, config, obstacles=everything)


def make_command_filter(parameters: NodeParameters, obstacles: Sequence[Obstacle] = ()) -> CommandFilter:
    """The core of the node for `parameters`, with `obstacles` beside those of the site.

    Raises:
        ConfigurationError: as `make_filter`, or a name or value of the parameters is not usable.
        UnknownNameError: there is no such robot.
    """
    site_file = Path(parameters.site) if parameters.site else None
    safety = make_filter(parameters.robot, site_file, parameters.period, obstacles)
    imported = parameters.robot not in BUILTIN_ROBOTS
    description = DescriptionCheck(
        safety.robot_model,
        JointOrder(safety.robot_model, parameters).names_of_robot,
        mode=parameters.check_description,
        digest=source_digest(Path(parameters.robot)) if imported else None,
        base_frame=parameters.base_frame,
    )
    return CommandFilter(safety, parameters, description)
