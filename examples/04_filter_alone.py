"""The filter behind your own controller: the five essential lines, and the reaction to each status.

Run: `python examples/04_filter_alone.py`. Needs no simulator: the arm follows its velocity command with a
first-order lag.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dualbrain import Box, FilterResult, FilterStatus, HalfSpace, Obstacle, Pose, SafetyFilter, Sphere, load_robot

Array = NDArray[np.float64]


def my_controller(q: Array, now: float) -> Array:
    """A joint-space controller [rad/s] that moves to the right and back and ignores obstacles."""
    goal = np.array([0.9 * np.sin(1.2 * now), -0.1, 0.0, -2.0, 0.0, 2.0, 0.785])
    return np.clip(3.0 * (goal - q), -1.5, 1.5)


def reaction(result: FilterResult) -> str:
    """The reaction of the caller. `result.u` may be sent in every case: it is finite and within all joint limits."""
    match result.status:
        case FilterStatus.SAFE | FilterStatus.MODIFIED:
            return "continue"
        case FilterStatus.RELAXED:
            return "braking; end the task if it lasts 50 ms"
        case FilterStatus.STOPPED:
            return "braking; correct the input"
        case FilterStatus.FAULT:
            return "braking; cut the drive if it lasts 50 ms"


def main() -> None:
    """Move for four seconds between a static crate and a moving ball."""
    robot_model = load_robot("panda")  # 1
    table = Obstacle("table", HalfSpace())
    crate = Obstacle("crate", Box((0.1, 0.1, 0.2)), Pose((0.45, 0.42, 0.2)), margin=0.01)
    safety = SafetyFilter(robot_model, obstacles=[table, crate])  # 2

    q, v, dt, last = np.array(robot_model.home), np.zeros(robot_model.n), robot_model.period, ""
    for tick in range(4000):
        now = tick * dt
        if tick % 33 == 0:  # a camera at 30 Hz; the filter extrapolates with velocity and error bound
            position = (0.95 - 0.15 * now, -0.35, 0.45)
            ball = Obstacle(
                "ball", Sphere(0.06), Pose(position), velocity=(-0.15, 0.0, 0.0), velocity_error=0.02, static=False
            )
            safety.observe([ball], stamp=now)  # 3
        result = safety(q, v, my_controller(q, now), now, opening=0.0)  # 4
        if (text := f"{result.status.name}, {reaction(result)}") != last or tick % 500 == 0:
            last = text
            print(f"{now:5.3f} s  h {result.h_min * 1e3:5.1f} mm  {text}: {result.explain()}")  # 5
        v = v + (result.u - v) * dt / robot_model.tracking.lag
        q = q + dt * v


if __name__ == "__main__":
    main()
