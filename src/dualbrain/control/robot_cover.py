"""The spheres of the robot, and their least barrier value h for an obstacle as the next step of the filter computes it.

The filter evaluates h at the configuration q + v · lag, inflates a grasped object by its error, moves an obstacle along
its velocity from the stamp of its observation to the time of the step, and lets its margin grow with its velocity
error. A cover does the same, so that a choice made with it before a step holds in that step.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot, inf
from types import EllipsisType

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.distance import signed_distance
from dualbrain.core.geometry.shapes import Box, Capsule, Sphere
from dualbrain.robots.differential_drive import integrate_arc
from dualbrain.robots.interface import RobotState
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotCover:
    """Spheres of the robot that keep away from obstacles: centres (k, 3) [m], radii (k,) [m], parts by sphere.

    The radii include the error of a grasped object. `parts` holds for each sphere the names by which permits refer to
    it. `permits` are the permitted pairs of a part and an obstacle. `age` [s] is the age of the obstacles' observation
    in the next step.
    """

    centres: Array
    radii: Array
    parts: tuple[tuple[str, ...], ...]
    permits: frozenset[tuple[str, str]] = frozenset()
    age: float = 0.0

    def clearance(self, obstacle: Obstacle) -> float:
        """Least h [m] of `obstacle` and all spheres without a permit; infinite if there are none."""
        permitted = {part for part, name in self.permits if name == obstacle.name}
        if not permitted:
            return self._least(obstacle, ...)
        return self._least(obstacle, [i for i, parts in enumerate(self.parts) if permitted.isdisjoint(parts)])

    def part_clearance(self, part: str, obstacle: Obstacle) -> float:
        """Least h [m] of `obstacle` and the spheres of `part`, permitted or not; infinite if it has no spheres."""
        return self._least(obstacle, [i for i, parts in enumerate(self.parts) if part in parts])

    def is_clear(self, obstacle: Obstacle, reserve: float) -> bool:
        """Whether h of all spheres is at least `reserve` [m], by the sphere around `obstacle`: fast, sufficient."""
        offsets = self.centres - self._position(obstacle)
        nearest = float((np.sqrt(np.einsum("ij,ij->i", offsets, offsets)) - self.radii).min(initial=inf))
        return nearest - extent(obstacle) - self._margin(obstacle) >= reserve

    def _least(self, obstacle: Obstacle, chosen: list[int] | EllipsisType) -> float:
        """Least h [m] of `obstacle` and the `chosen` spheres at the time of the next step."""
        relative = self.centres[chosen] - self.age * np.asarray(obstacle.velocity)
        distances = signed_distance(obstacle.shape, obstacle.pose, relative) - self.radii[chosen]
        return float(distances.min(initial=inf)) - self._margin(obstacle)

    def _position(self, obstacle: Obstacle) -> Array:
        return np.asarray(obstacle.pose.position) + self.age * np.asarray(obstacle.velocity)

    def _margin(self, obstacle: Obstacle) -> float:
        return obstacle.margin + self.age * obstacle.velocity_error


class RobotSpheres:
    """The spheres of the robot of one filter, without those of a base that is bolted down."""

    def __init__(self, safety: SafetyFilter) -> None:
        """Find the parts of all spheres of the robot model."""
        self._safety = safety
        model = safety.robot_model
        links = [link for link in model.links for sphere in model.spheres if sphere.link == link.name]
        self._count = len(links)
        self._first = np.array([i for i, link in enumerate(links) if link.frame > 0], np.intp)
        self._parts: tuple[tuple[str, ...], ...] = tuple((link.name, link.group) for link in links if link.frame > 0)
        self._lag = model.tracking.lag if safety.config.lag_compensation else 0.0
        self._base_lag = (model.base_lag or 0.0) + self._lag if safety.config.lag_compensation else 0.0

    def at(self, state: RobotState, age: float = 0.0) -> RobotCover:
        """The spheres at `state`, as the filter places them, its permits, and the `age` [s] of the observation."""
        q = self._advanced(np.asarray(state.q, np.float64), np.asarray(state.v, np.float64))
        centres, radii, groups = self._safety.spheres(q, state.opening)
        tables, held = self._safety.tables, np.arange(self._count, len(radii))
        chosen = np.concatenate([self._first, held])
        errors = np.where(chosen >= self._count, tables.held_error, 0.0)
        parts = (*self._parts, *((group,) for group in groups[self._count :]))
        permits = frozenset((one.robot_part, one.obstacle) for one in tables.permits)
        return RobotCover(
            centres=centres[chosen],
            radii=radii[chosen] + errors,
            parts=parts,
            permits=permits,
            age=max(0.0, age),
        )

    def _advanced(self, q: Array, v: Array) -> Array:
        """The configuration (nq,) at which the filter evaluates h: ahead of `q` by the lag of joints and base."""
        if not self._safety.robot_model.is_mobile:
            return q + self._lag * v
        x, y, heading = q[:3].tolist()
        speed, turn = v[:2].tolist()
        base = integrate_arc(x, y, heading, speed, turn, self._base_lag)
        return np.concatenate([base, q[3:] + self._lag * v[2:]])


def extent(obstacle: Obstacle) -> float:
    """Radius [m] of the sphere around the centre of `obstacle` that contains its shape."""
    match obstacle.shape:
        case Sphere(radius=radius):
            return radius
        case Capsule(radius=radius, half_length=half_length):
            return radius + half_length
        case Box(half_extents=half_extents):
            return hypot(*half_extents)
        case _:
            return inf
