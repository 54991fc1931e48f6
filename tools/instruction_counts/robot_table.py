"""A robot model as a C header for `closed_loop.c`."""

from __future__ import annotations

from typing import Any

import numpy as np

from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.kernel import kernel_model

REAL_ARRAYS = (
    "joint_rotation",
    "joint_offset",
    "q_lower",
    "q_upper",
    "v_max",
    "a_max",
    "j_max",
    "tracking",
    "scale",
    "tool_rotation",
    "tool_offset",
    "spheres",
)
INTEGER_ARRAYS = ("joint_kind", "link_frame", "link_first", "held_links", "pairs")
SETTINGS = (
    "period",
    "alpha",
    "alpha_self",
    "alpha_joint",
    "recovery",
    "sampling",
    "rounding",
    "self_margin",
    "lag",
    "speed_limit",
    "state_age_max",
    "scene_age_max",
)


def robot_table(name: str) -> str:
    """The C header of a robot with the default configuration of the filter; float literals have the exact bits."""
    robot = load_robot(name)
    model = kernel_model(robot, FilterConfig())
    sizes = {
        "JOINTS": robot.n,
        "LINKS": len(robot.links),
        "SPHERES": len(robot.spheres),
        "PAIRS": np.asarray(model["pairs"]).size // 2,
        "HELD_LINKS": np.asarray(model["held_links"]).size,
        "SPEED_FIRST_JOINT": int(model["speed_first_joint"]),
    }
    lines = [f"#define ROBOT_{key} {value}" for key, value in sizes.items()]
    lines += [f"#define ROBOT_{key.upper()} {_real(model[key])}" for key in SETTINGS]
    lines += [_array(key, "dbk_real", model[key]) for key in REAL_ARRAYS]
    lines += [_array(key, "int32_t", model[key]) for key in INTEGER_ARRAYS]
    return "\n".join([*lines, _array("home", "dbk_real", robot.home)]) + "\n"


def _array(name: str, kind: str, values: Any) -> str:
    flat = np.ravel(np.asarray(values, float))
    words = [_real(value) if kind == "dbk_real" else str(int(value)) for value in flat] or ["0"]
    return f"static const {kind} robot_{name}[] = {{{', '.join(words)}}};"


def _real(value: float) -> str:
    return f"{float(np.float32(value)).hex()}f"
