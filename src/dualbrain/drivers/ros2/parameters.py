"""Parameters of the node, read from a YAML file in the form of ROS 2."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, cast

import msgspec

from dualbrain.core.untrusted.bounded_file import FileRefusal, read_regular_file
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.safety.integration.policy_guard.guard import Deviation

MAX_FILE_BYTES = 2**20
SECTION, EVERY_NODE = "ros__parameters", "/**"
_TOPIC = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*")
_TIMES = ("period", "command_timeout", "max_state_age", "recovery_time", "path_tolerance", "trajectory_gain")


class NodeParameters(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters of the node.

    - `robot`, `site`: robot model and site file, as for `dualbrain run`.
    - `joints`: the joints in the order of the controller, by their ROS names; `robot_joints`: the names of the same
      joints in the robot model. Both are those of the robot model by default.
    - `command_type`: "velocity" (Float64MultiArray, in the order of `joints`), "trajectory" (JointTrajectory) or
      "twist" (TwistStamped in `base_frame` or `tool_frame`). The safe command is always a Float64MultiArray.
    - `period` [s]: period of the filter; one step per period, for the joint state that is closest to its due time.
    - `command_timeout` [s], `state_timeout` [s] (0: three periods): silence after which the arm comes to rest.
    - `max_state_age` [s]: largest difference of the stamp of a joint state from the clock.
    - `recovery_time` [s]: the arm rests this long after the last unusable input.
    - `trajectory_gain` [1/s] and `path_tolerance` [rad]: u_nom = v_d + gain (q_d − q); beyond the tolerance the
      trajectory is cancelled.
    - `check_description`: "exact" (the URDF file that the robot was imported from; of a packaged robot, and with a
      warning of one without an import record, its kinematics), "kinematics", or "none".
    - `one_source`: whether the arm rests while more than one publisher of commands exists.
    - `deviation`: as for `PolicyGuard`.
    """

    robot: str = "panda"
    site: str = ""
    joints: tuple[str, ...] = ()
    robot_joints: tuple[str, ...] = ()
    command_type: Literal["velocity", "trajectory", "twist"] = "velocity"
    command_topic: str = "/dualbrain_filter/commands"
    safe_command_topic: str = "/dualbrain_filter/safe_commands"
    joint_states_topic: str = "/joint_states"
    robot_description_topic: str = "/robot_description"
    base_frame: str = ""
    tool_frame: str = ""
    period: float = 0.005
    command_timeout: float = 0.1
    state_timeout: float = 0.0
    max_state_age: float = 0.1
    recovery_time: float = 0.5
    trajectory_gain: float = 5.0
    path_tolerance: float = 0.35
    check_description: Literal["exact", "kinematics", "none"] = "exact"
    one_source: bool = True
    deviation: Deviation = "nearest"
    use_sim_time: bool = False

    @property
    def state_silence(self) -> float:
        """The silence of the joint states [s] after which the arm comes to rest."""
        return self.state_timeout or 3.0 * self.period

    def validate(self) -> NodeParameters:
        """These parameters; raises `ConfigurationError` for a value that cannot be used."""
        for name in _TIMES:
            value = getattr(self, name)
            if not 0.0 < value < 1e3:
                raise ConfigurationError(f"parameter {name}", got=value, allowed="above 0, below 1000")
        if self.state_timeout and not self.period <= self.state_timeout < 1e3:
            allowed = f"0, or at least the period {self.period:g}"
            raise ConfigurationError("parameter state_timeout [s]", got=self.state_timeout, allowed=allowed)
        for name in ("command_topic", "safe_command_topic", "joint_states_topic", "robot_description_topic"):
            if not _TOPIC.fullmatch(getattr(self, name)):
                allowed = "a topic name such as /velocity_controller/commands"
                raise ConfigurationError(f"parameter {name}", got=getattr(self, name), allowed=allowed)
        if absolute_topic(self.command_topic) == absolute_topic(self.safe_command_topic):
            raise ConfigurationError.stating(
                f"The node would read its own commands from {self.safe_command_topic}.",
                fix="Give `command_topic` and `safe_command_topic` different names.",
            )
        return self


def absolute_topic(name: str) -> str:
    """The topic called `name` with its leading slash."""
    return f"/{name.lstrip('/')}"


def read_parameters(path: Path, node_name: str) -> NodeParameters:
    """The parameters in the YAML file `path`: those of every node (`/**`), then those of `node_name`.

    Raises:
        ConfigurationError: The file cannot be read, has another form, or a value of another type or range.
        UnknownNameError: A parameter does not exist.
        ModuleNotFoundError: PyYAML (extra `ros2`) is not installed.
    """
    data = read_regular_file(path, MAX_FILE_BYTES)
    if isinstance(data, FileRefusal):
        raise ConfigurationError.stating(data.sentence, fix=data.fix)
    return parse_parameters(data, path.name, node_name)


def parse_parameters(data: bytes, file_name: str, node_name: str) -> NodeParameters:
    """The parameters in `data`, the content of the file called `file_name`; raises as `read_parameters` does."""
    document = _parse_yaml(data, file_name)
    values: dict[str, Any] = {}
    for section in (EVERY_NODE, node_name, f"/{node_name}"):
        values |= _section(document, section, file_name)
    if not values:
        raise ConfigurationError.stating(
            f"{file_name} has no parameters of {node_name}.",
            fix=f"Write them below `{EVERY_NODE}:` and `{SECTION}:`, as for every ROS 2 node.",
        )
    for name in values:
        if name not in NodeParameters.__struct_fields__:
            raise UnknownNameError("parameter", str(name)[:80], NodeParameters.__struct_fields__, owner=node_name)
    try:
        return msgspec.convert(values, NodeParameters).validate()
    except msgspec.ValidationError as error:
        fix = "See docs/how-to/guard/ros2.md for the parameters."
        raise ConfigurationError.stating(f"{file_name}: {error}.", fix=fix) from error


def _parse_yaml(data: bytes, file_name: str) -> dict[str, Any]:
    yaml = import_module("yaml")
    try:
        document: object = yaml.safe_load(data)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        problem = f"{file_name} is not YAML: {' '.join(str(error).split())[:200]}."
        raise ConfigurationError.stating(problem, fix="Correct the file.") from error
    if not isinstance(document, dict):
        found = type(document).__name__
        raise ConfigurationError(f"content of {file_name}", got=found, allowed=f"a mapping with `{EVERY_NODE}`")
    return cast("dict[str, Any]", document)


def _section(document: dict[str, Any], name: str, file_name: str) -> dict[str, Any]:
    """The parameters below `name`; none if the file has no such section."""
    section: object = document.get(name)
    if section is None:
        return {}
    parameters: object = cast("dict[str, Any]", section).get(SECTION) if isinstance(section, dict) else None
    if not isinstance(parameters, dict):
        allowed = f"a mapping with the mapping `{SECTION}`"
        raise ConfigurationError(f"{name} in {file_name}", got=str(parameters)[:80], allowed=allowed)
    return cast("dict[str, Any]", parameters)
