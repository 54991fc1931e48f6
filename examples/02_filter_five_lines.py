"""The filter alone: an arm is driven down at a table and to the side at a post, and is let through nowhere.

Run: `python examples/02_filter_five_lines.py`. Needs neither a planner, nor a simulator, nor weights: here joint angles
simply follow the control, q ← q + dt u.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dualbrain.core.geometry.shapes import Capsule, HalfSpace, Pose
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import FilterConfig, Obstacle, SafetyFilter

PANDA = load_robot("panda")
TABLE = Obstacle("table", HalfSpace(), Pose((0.0, 0.0, 0.0)))
POST = Obstacle("post", Capsule(radius=0.03, half_length=0.2), Pose((0.50, 0.25, 0.2)), margin=0.009)
CONFIG = FilterConfig(lag_compensation=False, tracking_error=0.0)  # q follows u exactly in this loop


def drive(direction: tuple[float, float, float], seconds: float) -> None:
    """Push the tool along `direction` [m/s] from home and print what the filter makes of it."""
    safety = SafetyFilter(PANDA, CONFIG)
    safety.observe([TABLE, POST], stamp=0.0)
    state, wish = home_state(PANDA), np.array([*direction, 0.0, 0.0, 0.0])
    print(f"\npush at {np.linalg.norm(direction):.2f} m/s along {direction}")
    for tick in range(round(seconds / PANDA.period)):
        now = tick * PANDA.period
        tool = safety.tool(state.q)
        u_nom = np.linalg.pinv(tool.jacobian) @ wish
        answer = safety.filter(state, u_nom, now)
        state = replace(state, q=state.q + PANDA.period * answer.u, stamp=now + PANDA.period)
        if tick % 400 == 0:
            x, y, z = tool.position
            print(
                f"{now:5.2f} s  tool ({x:.2f}, {y:.2f}, {z:.2f}) m  h_min {answer.h_min * 1e3:6.1f} mm"
                f"  delta {answer.delta:.3f}  {answer.status.name}: {answer.explain()}"
            )


def main() -> None:
    """Down at the table, then sideways at the post."""
    drive((0.0, 0.0, -0.3), 2.4)
    drive((0.0, 0.25, -0.1), 2.4)


if __name__ == "__main__":
    main()
