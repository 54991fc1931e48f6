"""Tables of a filter for programs in C or C++ that run the kernel without Python: robot model and obstacles as text.

The first line is `dualbrain kernel tables 1`. Every other line is a key, the number of its values, and the values:
names for `joints`, else numbers, written so that they read back to the same float64. The keys of the robot model are
those of the compiled kernel's binding; `obstacles` has 29 columns per obstacle and `near` five: index, speed, distance,
brake, approach. The spheres of the fingers cover every opening, because the reader may not know the opening.
"""

from __future__ import annotations

import numpy as np

from dualbrain.errors import ConfigurationError
from dualbrain.safety.cbf.filter import SafetyFilter, links_by_part
from dualbrain.safety.cbf.kernel import kernel_model, obstacle_table

HEADER = "dualbrain kernel tables 1"


def format_kernel_tables(safety: SafetyFilter) -> str:
    """The tables of `safety`, whose weight R is the default one.

    Raises:
        ConfigurationError: the robot has a mobile base, an obstacle moves, the filter has contacts or rows, a joint has
            a name with spaces, or the precision is not float32: a reader of the tables would not stay safe.
    """
    robot_model, tables = safety.robot_model, safety.tables
    moving = [obstacle.name for obstacle in tables.obstacles if obstacle.moves]
    spaced = [joint.name for joint in robot_model.joints if len(joint.name.split()) != 1]
    for found, problem in (
        (robot_model.is_mobile, f"{robot_model.name} has a mobile base"),
        (moving, f"{', '.join(moving)} moves"),
        (tables.permits or safety.extra_rows, "The filter has permitted contacts or additional rows"),
        (spaced, f"The name of joint {', '.join(spaced)!r} is not one word"),
        (safety.config.precision != "float32", f"The precision is {safety.config.precision}"),
    ):
        if found:
            fix = "Run the filter in Python, or leave it out of the tables."
            raise ConfigurationError.stating(f"{problem}; kernel tables cannot express that.", fix=fix)
    model = kernel_model(robot_model, safety.config)
    model["spheres"] = model.pop("hull_spheres", model["spheres"])
    model.pop("opening_max", None)
    near = [
        (index, one.near.speed, one.near.distance, one.near.brake, one.near.approach)
        for index, one in enumerate(tables.obstacles)
        if one.near is not None
    ]
    model |= {"obstacles": obstacle_table(tables.obstacles, links_by_part(robot_model)), "near": near}
    names = [joint.name for joint in robot_model.joints]
    lines = [HEADER, f"joints {len(names)} {' '.join(names)}"]
    for key, value in model.items():
        numbers = np.ravel(np.asarray(value, float)).tolist()
        lines.append(" ".join([key, str(len(numbers)), *map(repr, numbers)]))
    return "\n".join(lines) + "\n"
