"""A robot model as a C header for `closed_loop.c`: the tables of the firmware, sizes, and the home posture."""

from __future__ import annotations

from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.target.robot_tables import render_reals, render_robot_tables


def robot_table(name: str) -> str:
    """The C header of a robot with the default configuration of the filter; float literals have the exact bits."""
    robot = load_robot(name)
    sizes = {"JOINTS": robot.n, "SPHERES": len(robot.spheres), "PAIRS": len(robot.self_pairs.kept)}
    lines = [f"#define ROBOT_{key} {value}" for key, value in sizes.items()]
    home = f"static const dbk_real robot_home[] = {render_reals(robot.home)};"
    return "\n".join([*lines, render_robot_tables(robot, FilterConfig()), home]) + "\n"
