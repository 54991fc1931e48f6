"""Choice between two valid estimates of an obstacle, so that an observation does not make a margin short.

Every estimate is a ball that contains the true position: a centre and a margin. The former estimate, moved along its
velocity and grown by its velocity error, and the new observation are both valid, and so is every convex combination
(1 - s) of the one and s of the other: ‖x - c‖ ≤ (1 - s) m₁ + s m₂. The largest s of `SHARES` is chosen for which h of
the obstacle stays at least `RESERVE`, or at least as large as with the former estimate. The robot therefore never
becomes too close by noise alone, and the true position remains within the margin in force.

A new observation is taken over at once, at every h, if it contradicts the former estimate: an object at rest is
observed further from it than its error bound, or a moving one outside both balls. It then really moved.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from math import inf

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.distance import signed_distance
from dualbrain.core.geometry.shapes import Pose
from dualbrain.robots.interface import RobotState
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle

Array = NDArray[np.float64]

RESERVE = 5e-4
"""Barrier value h [m] down to which a new observation is taken over completely."""
SHARES = (1.0, 0.5, 0.25)
"""Shares s of the new observation that are tried, largest first; then the former estimate stays."""
PERSON_ACCELERATION = 1.0
"""Declared bound of the acceleration of a moving obstacle [m/s²]; the simulated person accelerates with 0.5."""
MAX_HELD_TIME = 1.0
"""Time [s] without an observation after which the former estimate of an obstacle is not used any more."""


@dataclass(frozen=True, slots=True)
class RobotCover:
    """Spheres of the robot that keep away from obstacles: centres (k, 3) [m], radii (k,) [m], parts by sphere.

    `parts` holds for each sphere the names by which permits refer to it. `permits` are the permitted pairs of a part
    and an obstacle, `margin` (k,) [m] the additional margin of each sphere.
    """

    centres: Array
    radii: Array
    parts: tuple[Collection[str], ...]
    permits: frozenset[tuple[str, str]] = frozenset()

    def clearance(self, obstacle: Obstacle) -> float:
        """Least h [m] of `obstacle` and all spheres without a permit; infinite if there are none."""
        chosen = [
            i
            for i, parts in enumerate(self.parts)
            if not (self.permits and any((part, obstacle.name) in self.permits for part in parts))
        ]
        if not chosen:
            return inf
        distances = signed_distance(obstacle.shape, obstacle.pose, self.centres[chosen]) - self.radii[chosen]
        return float(distances.min()) - obstacle.margin


def robot_cover(safety: SafetyFilter, state: RobotState) -> RobotCover:
    """The spheres of the robot at `state`, as the filter places them, without those of a base that is bolted down."""
    model = safety.robot_model
    q = np.asarray(state.q, np.float64)
    if not model.is_mobile and safety.config.lag_compensation:
        q = q + model.tracking.lag * np.asarray(state.v, np.float64)
    centres, radii, groups = safety.spheres(q, state.opening)
    links = [link for link in model.links for sphere in model.spheres if sphere.link == link.name]
    parts = [(link.name, link.group) for link in links] + [(group,) for group in groups[len(links) :]]
    moved = [i for i in range(len(parts)) if i >= len(links) or links[i].frame > 0]
    permits = frozenset((one.robot_part, one.obstacle) for one in safety.tables.permits)
    return RobotCover(centres[moved], radii[moved], tuple(parts[i] for i in moved), permits)


class ObstacleEstimates:
    """The estimates in force. State: the obstacles as given to the filter, and their stamp [s]."""

    def __init__(self) -> None:
        """Start without estimates."""
        self._former: dict[str, tuple[float, Obstacle]] = {}

    def update(
        self,
        obstacles: Sequence[Obstacle],
        stamp: float,
        *,
        moved: Collection[str],
        h_min: float,
        cover: Callable[[], RobotCover],
    ) -> tuple[Obstacle, ...]:
        """The estimates of `obstacles`, observed at `stamp` [s], that the filter gets.

        Observations of the objects in `moved` (just released) are taken over at once, and so are all if `h_min` [m],
        the least barrier value of the last step, exceeds every change. `cover` computes the robot's spheres.
        """
        offers = [(one, self._prior(one, stamp)) for one in obstacles]
        near = [prior for one, prior in offers if prior is not None and one.name not in moved]
        largest = max((_change(one, prior) for one, prior in offers if prior is not None), default=0.0)
        robot = cover() if near and not h_min > largest + RESERVE else None
        chosen: list[Obstacle] = []
        for one, prior in offers:
            if robot is None or prior is None or one.name in moved or _contradicts(one, prior):
                chosen.append(one)
            else:
                chosen.append(_choose(one, prior, robot))
        self._former = {one.name: (stamp, one) for one in chosen}
        return tuple(chosen)

    def _prior(self, new: Obstacle, stamp: float) -> Obstacle | None:
        """The former estimate of the obstacle `new` at `stamp` [s], None if there is none that can be compared."""
        found = self._former.get(new.name)
        if found is None or new.margin == 0.0:
            return None
        former_stamp, former = found
        age = stamp - former_stamp
        same = former.shape == new.shape and former.pose.quaternion == new.pose.quaternion
        if not same or not 0.0 <= age <= MAX_HELD_TIME:
            return None
        x, y, z = (p + v * age for p, v in zip(former.pose.position, former.velocity, strict=True))
        margin = former.margin + former.velocity_error * age
        return msgspec.structs.replace(new, pose=Pose((x, y, z), new.pose.quaternion), margin=margin)


def with_acceleration(obstacle: Obstacle, interval: float) -> Obstacle:
    """A moving `obstacle` whose velocity error covers its acceleration until the next observation, `interval` [s]."""
    if not obstacle.moves:
        return obstacle
    return msgspec.structs.replace(obstacle, velocity_error=obstacle.velocity_error + PERSON_ACCELERATION * interval)


def _choose(new: Obstacle, prior: Obstacle, robot: RobotCover) -> Obstacle:
    """The combination of two valid estimates with the largest share of `new` that leaves the margin intact."""
    needed = min(robot.clearance(prior), RESERVE)
    for share in SHARES:
        mixed = _combine(prior, new, share)
        if robot.clearance(mixed) >= needed:
            return mixed
    return prior


def _combine(prior: Obstacle, new: Obstacle, share: float) -> Obstacle:
    """The estimate with the `share` of `new`: centre and margin are convex combinations."""
    if share == 1.0:
        return new
    x, y, z = ((1.0 - share) * a + share * b for a, b in zip(prior.pose.position, new.pose.position, strict=True))
    margin = (1.0 - share) * prior.margin + share * new.margin
    return msgspec.structs.replace(new, pose=Pose((x, y, z), new.pose.quaternion), margin=margin)


def _contradicts(new: Obstacle, prior: Obstacle) -> bool:
    """Whether the observation `new` shows that the former estimate is not valid any more."""
    bound = prior.margin + new.margin if new.moves else new.margin
    return _distance(new, prior) > bound


def _distance(a: Obstacle, b: Obstacle) -> float:
    return float(np.linalg.norm(np.subtract(a.pose.position, b.pose.position)))


def _change(new: Obstacle, prior: Obstacle) -> float:
    """Largest fall of h [m] by taking over `new`."""
    return _distance(new, prior) + max(0.0, new.margin - prior.margin)
