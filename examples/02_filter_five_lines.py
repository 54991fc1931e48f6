"""The safety filter alone: an arm is pushed down at a table and sideways at a post, and touches neither.

Run: `python examples/02_filter_five_lines.py`. Needs no planner, no simulator and no model files: the joints follow the
control exactly, q ← q + dt u.
"""

from __future__ import annotations

import numpy as np

from dualbrain import Capsule, FilterConfig, HalfSpace, Obstacle, Pose, SafetyFilter, load_robot

PANDA = load_robot("panda")
TABLE = Obstacle("table", HalfSpace())
POST = Obstacle("post", Capsule(radius=0.03, half_length=0.2), Pose((0.50, 0.25, 0.2)), margin=0.009)
CONFIG = FilterConfig(lag_compensation=False, tracking_error=0.0)  # q follows u exactly


def drive(direction: tuple[float, float, float], seconds: float) -> None:
    """Push the tool along `direction` [m/s] from the home position and print the results of the filter."""
    safety = SafetyFilter(PANDA, CONFIG, obstacles=[TABLE, POST])
    q, v, twist = np.array(PANDA.home), np.zeros(PANDA.n), np.array([*direction, 0.0, 0.0, 0.0])
    print(f"\npush at {np.linalg.norm(direction):.2f} m/s along {direction}")
    for tick in range(round(seconds / PANDA.period)):
        now = tick * PANDA.period
        tool = safety.tool(q)
        result = safety(q, v, u_nom=np.linalg.pinv(tool.jacobian) @ twist, now=now)
        q, v = q + PANDA.period * result.u, result.u
        if tick % 400 == 0:
            x, y, z = tool.position
            print(
                f"{now:5.2f} s  tool ({x:.2f}, {y:.2f}, {z:.2f}) m  h_min {result.h_min * 1e3:6.1f} mm"
                f"  delta {result.delta:.3f}  {result.status.name}: {result.explain()}"
            )


def main() -> None:
    """Push down at the table, then sideways at the post."""
    drive((0.0, 0.0, -0.3), 2.4)
    drive((0.0, 0.25, -0.1), 2.4)


if __name__ == "__main__":
    main()
