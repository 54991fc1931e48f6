"""dualbrain ros2: the safety filter as a ROS 2 node, and the tables of the ros2_control controller."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
from cyclopts import Parameter

from dualbrain.cli.common.console import print_message
from dualbrain.cli.common.exit_codes import ExitCode

if TYPE_CHECKING:
    from dualbrain.drivers.ros2.parameters import NodeParameters
    from dualbrain.safety.cbf.obstacles import Obstacle

NODE_NAME = "dualbrain_filter"


def node(
    *,
    robot: str = "",
    params: Path | None = None,
    site: Path | None = None,
    scene: str = "",
    commands: str = "",
    safe_commands: str = "",
    name: str = NODE_NAME,
    domain: Annotated[int, Parameter(show_default=False)] = -1,
) -> int:
    """Guard the commands of a controller in ROS 2 until Ctrl-C; no ROS installation is needed.

    The options replace entries of the parameter file.

    Parameters
    ----------
    robot
        The robot, or a folder of `dualbrain robot init`. Default: that of the parameters, else panda.
    params
        Parameters in a YAML file in the form of ROS 2; see docs/how-to/guard/ros2.md.
    site
        Site file (TOML) with planes and keep-out boxes; see docs/how-to/site.md.
    scene
        A number, FAMILY:SEED or a scene file, whose objects are obstacles. None of them may move.
    commands
        Topic that the policy or planner publishes on.
    safe_commands
        Topic of the controller.
    name
        Name of the node.
    domain
        DDS domain. Default: ROS_DOMAIN_ID, else 0.
    """
    from dualbrain.cli.common.signals import interrupt_handler
    from dualbrain.drivers.ros2.assembly import make_command_filter
    from dualbrain.drivers.ros2.dds_node import DdsNode

    parameters = _parameters(params, name, robot, site, commands, safe_commands)
    core = make_command_filter(parameters, _scene_obstacles(scene, parameters.robot) if scene else ())
    running = DdsNode(core, name, domain if domain >= 0 else _domain())
    stopped: list[bool] = []
    print_message(
        f"{name} guards {parameters.command_topic} -> {parameters.safe_command_topic} ({parameters.command_type}, "
        f"{1.0 / parameters.period:g} Hz). Ctrl-C brings the arm to rest and ends it."
    )
    with interrupt_handler(lambda: stopped.append(True)):
        running.run(lambda: bool(stopped))
    return ExitCode.SUCCESS


def tables(*, out: Path, robot: str = "panda", site: Path | None = None, scene: str = "", period: float = 0.001) -> int:
    """Write the tables of robot and obstacles that the controller in integrations/ros2_control reads.

    Parameters
    ----------
    out
        File to write.
    robot
        The robot, or a folder of `dualbrain robot init`.
    site
        Site file (TOML) with planes and keep-out boxes; see docs/how-to/site.md.
    scene
        A number, FAMILY:SEED or a scene file, whose objects are obstacles. None of them may move.
    period
        Period of the controller manager in s.
    """
    from dualbrain.core.storage.atomic_files import write_atomically
    from dualbrain.drivers.ros2.assembly import make_filter
    from dualbrain.safety.integration.kernel_tables import format_kernel_tables

    safety = make_filter(robot, site, period, _scene_obstacles(scene, robot) if scene else ())
    write_atomically(out, format_kernel_tables(safety).encode())
    print_message(f"{out}: {safety.robot_model.name} at {1.0 / period:g} Hz, {len(safety.tables.obstacles)} obstacles")
    return ExitCode.SUCCESS


def _parameters(
    params: Path | None, name: str, robot: str, site: Path | None, commands: str, safe_commands: str
) -> NodeParameters:
    """The parameters of the file with those of the options."""
    from dualbrain.drivers.ros2.parameters import NodeParameters, read_parameters

    given = {
        "robot": robot,
        "site": str(site or ""),
        "command_topic": commands,
        "safe_command_topic": safe_commands,
    }
    parameters = read_parameters(params, name) if params else NodeParameters()
    changes = {key: value for key, value in given.items() if value}
    return msgspec.structs.replace(parameters, **changes).validate()


def _domain() -> int:
    """The DDS domain of the environment."""
    from dualbrain.errors import ConfigurationError

    text = os.environ.get("ROS_DOMAIN_ID", "") or "0"
    if not (text.isdecimal() and int(text) <= 232):
        raise ConfigurationError("ROS_DOMAIN_ID", got=text, allowed="0 to 232")
    return int(text)


def _scene_obstacles(scene: str, robot: str) -> tuple[Obstacle, ...]:
    """The objects of a scene as obstacles."""
    from dualbrain.grounding.offline_gate import scene_from_spec
    from dualbrain.safety.cbf.obstacles import obstacles_from_scene
    from dualbrain.simulation.scenes.generators.catalogue import open_scene

    return obstacles_from_scene(scene_from_spec(open_scene(scene, robot)), known=(), held=None)
