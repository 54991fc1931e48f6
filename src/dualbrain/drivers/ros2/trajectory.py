"""A joint trajectory: points with times, sampled as `joint_trajectory_controller` samples them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dualbrain.drivers.ros2.joint_order import JointOrder

Array = NDArray[np.float64]

MAX_POINTS = 1000
"""Most points of a trajectory: the node reads a longer one for more than 50 ms, in which it sends no command."""


@dataclass(frozen=True, slots=True)
class TrajectoryPoint:
    """A `JointTrajectoryPoint`: positions [rad], velocities [rad/s] or none, and the time from the start [s]."""

    positions: Sequence[float]
    velocities: Sequence[float]
    time: float


@dataclass(frozen=True, slots=True)
class TrajectoryMessage:
    """A `trajectory_msgs/JointTrajectory`; `start` [s] on the clock of ROS, 0: at its arrival."""

    names: Sequence[str]
    points: Sequence[TrajectoryPoint] = field(default=())
    start: float = 0.0


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Positions and velocities (k, n) in the order of the robot model at `times` (k,) [s] on the clock of ROS."""

    times: Array
    positions: Array
    velocities: Array | None

    def sample(self, time: float) -> tuple[Array, Array]:
        """Position and velocity (n,) at `time`: cubic between points with velocities, else linear; at rest outside."""
        index = int(np.searchsorted(self.times, time, side="right")) - 1
        if index < 0 or index >= len(self.times) - 1:
            end = min(max(index, 0), len(self.times) - 1)
            return self.positions[end], np.zeros(len(self.positions[end]))
        length = float(self.times[index + 1] - self.times[index])
        share = (time - float(self.times[index])) / length
        p0: Array = self.positions[index]
        p1: Array = self.positions[index + 1]
        if self.velocities is None:
            return p0 + share * (p1 - p0), (p1 - p0) / length
        v0, v1 = length * self.velocities[index], length * self.velocities[index + 1]
        cubic, square = 2.0 * (p0 - p1) + v0 + v1, 3.0 * (p1 - p0) - 2.0 * v0 - v1
        position = p0 + share * (v0 + share * (square + share * cubic))
        return position, (v0 + share * (2.0 * square + 3.0 * share * cubic)) / length


def read_trajectory(message: TrajectoryMessage, order: JointOrder, q: Array, now: float) -> Trajectory | str:
    """The trajectory from `q` (n,) [rad] at `now` [s] through the points of `message`, or why it is unusable."""
    indices = order.read_named(message.names, "The trajectory")
    if isinstance(indices, str):
        return indices
    if not 1 <= len(message.points) <= MAX_POINTS:
        return f"The trajectory has {len(message.points)} points. Remedy: send 1 to {MAX_POINTS} points"
    count, with_velocities = len(message.names), len(message.points[0].velocities) > 0
    for number, point in enumerate(message.points):
        if problem := _point_problem(point, count, with_velocities=with_velocities):
            return f"Point {number} of the trajectory {problem}"
    start = message.start or now
    times = start + np.array([point.time for point in message.points])
    positions = np.array([point.positions for point in message.points], float)[:, indices]
    velocities = (
        np.array([point.velocities for point in message.points], float)[:, indices] if with_velocities else None
    )
    if not (np.isfinite(times).all() and (np.diff(times) > 0.0).all() and message.points[0].time >= 0.0):
        return "The times of the trajectory do not increase. Remedy: give each point a later time_from_start"
    if times[-1] < now:
        return (
            f"The trajectory ended {now - times[-1]:.2f} s before it came. Remedy: plan a new one, and synchronise the "
            "clocks of the machines, or send it with the stamp 0"
        )
    if times[0] > now:  # it begins at the present position, at rest
        times, positions = np.concatenate([[now], times]), np.vstack([q, positions])
        velocities = None if velocities is None else np.vstack([np.zeros(len(q)), velocities])
    return Trajectory(times, positions, velocities)


def _point_problem(point: TrajectoryPoint, count: int, *, with_velocities: bool) -> str:
    """Why a point of `count` joints is unusable, with a remedy, or ""."""
    if len(point.positions) != count:
        return f"has {len(point.positions)} positions for {count} joints. Remedy: give every joint a position"
    if len(point.velocities) != (count if with_velocities else 0):
        return f"has {len(point.velocities)} velocities. Remedy: give all points {count} velocities, or none"
    if not (np.isfinite(point.positions).all() and np.isfinite(point.velocities).all()):
        return "is not finite. Remedy: check the planner of the trajectory"
    return ""
