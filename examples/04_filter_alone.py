"""The filter in front of a controller of your own: five lines that matter, and what to do with the answer.

Run: `python examples/04_filter_alone.py`. Needs no simulator: the arm is a first-order lag behind its velocity command.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.shapes import Box, HalfSpace, Pose, Sphere
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import FilterResult, FilterStatus, Obstacle, SafetyFilter

Array = NDArray[np.float64]


def my_controller(q: Array, now: float) -> Array:
    """Somebody's joint-space controller [rad/s]: to the right and back, without an eye for what stands there."""
    goal = np.array([0.9 * np.sin(1.2 * now), -0.1, 0.0, -2.0, 0.0, 2.0, 0.785])
    return np.clip(3.0 * (goal - q), -1.5, 1.5)


def what_to_do(answer: FilterResult) -> str:
    """The answer's u may be written in every case: it is finite and within all limits of the joints."""
    match answer.status:
        case FilterStatus.SAFE | FilterStatus.MODIFIED:
            return "go on"
        case FilterStatus.RELAXED:
            return "braking; end the task if it lasts 50 ms"
        case FilterStatus.STOPPED:
            return "braking; mend the input"
        case FilterStatus.FAULT:
            return "braking; cut the drive if it lasts 50 ms"


def main() -> None:
    """Drive for four seconds between a crate that stands still and a ball that flies by."""
    robot_model = load_robot("panda")  # 1
    safety = SafetyFilter(robot_model)  # 2
    table = Obstacle("table", HalfSpace(), Pose((0.0, 0.0, 0.0)))
    crate = Obstacle("crate", Box((0.1, 0.1, 0.2)), Pose((0.45, 0.42, 0.2)), margin=0.01)

    q, v, dt, told = np.array(robot_model.home), np.zeros(robot_model.n), robot_model.period, ""
    for tick in range(4000):
        now = tick * dt
        if tick % 33 == 0:  # a camera at 30 Hz; velocity and its error bound let the filter look ahead in between
            place = (0.95 - 0.15 * now, -0.35, 0.45)
            ball = Obstacle(
                "ball", Sphere(0.06), Pose(place), velocity=(-0.15, 0.0, 0.0), velocity_error=0.02, static=False
            )
            safety.observe([table, crate, ball], stamp=now)  # 3
        answer = safety(q, v, my_controller(q, now), now, opening=0.0)  # 4
        if (words := f"{answer.status.name}, {what_to_do(answer)}") != told or tick % 500 == 0:
            told = words
            print(f"{now:5.3f} s  h {answer.h_min * 1e3:5.1f} mm  {words}: {answer.explain()}")  # 5
        v = v + (answer.u - v) * dt / robot_model.tracking.lag
        q = q + dt * v


if __name__ == "__main__":
    main()
