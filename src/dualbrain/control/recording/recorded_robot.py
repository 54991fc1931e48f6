"""The robot of a recording, from the data of its /episode message."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from dualbrain.errors import ConfigurationError
from dualbrain.robots.loader import find_model_faults, load_builtin_robot
from dualbrain.robots.model import RobotModel


def recorded_robot(data: Mapping[str, Any]) -> RobotModel:
    """The model in the `data` of an /episode message, or the packaged robot that it names; a name never opens a file.

    Raises `ConfigurationError` for an invalid model, `UnknownNameError` for a name of no packaged robot, and `KeyError`
    or `msgspec.ValidationError` for data of another form.
    """
    if "body" not in data:
        return load_builtin_robot(str(data["robot"]))
    robot_model = msgspec.convert(data["body"], RobotModel)
    for entry, got, allowed in find_model_faults(robot_model):
        raise ConfigurationError(f"{entry} of the recorded robot", got=got, allowed=allowed)
    return robot_model
