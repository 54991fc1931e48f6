"""Choice between two valid estimates of an obstacle, so that an observation does not make a margin short.

Every estimate is a ball that contains the true position: a centre and a margin. The former estimate, moved along its
velocity and grown by its velocity error, and the new observation are both valid, and so is every convex combination
(1 - s) of the one and s of the other: ‖x - c‖ ≤ (1 - s) m₁ + s m₂. The largest s of `SHARES` is chosen for which h of
the obstacle stays at least `RESERVE`, or at least as large as with the former estimate. The robot therefore never
becomes too close by noise alone, and the true position remains within the margin in force.

A new observation is taken over at once if it contradicts the former estimate: an object at rest is observed further
from it than its error bound, or a moving one outside both balls. It then really moved. If h would be below 0 at the new
place, or if an object appears there or is grasped next to it, its margin is *introduced*: it begins at the value with
h = `RESERVE`, and grows with `INTRODUCTION_RATE` to its full value. The obstacle itself is at its new place at once.
Meanwhile the rows demand that the robot retreats from it at that rate, and the margin in force is smaller than the
error bound. An obstacle that overlaps the robot by more than its margin has h < 0.

An observation is older than the step of the filter that uses it, and margins grow from its stamp. All values of h here
are those of the next step (`RobotCover`), and the margin of an introduced obstacle begins smaller by the growth until
then.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from math import asin, dist, inf

import msgspec

from dualbrain.control.robot_cover import RobotCover, extent
from dualbrain.core.geometry.shapes import Pose, Sphere
from dualbrain.safety.cbf.obstacles import Obstacle

RESERVE = 5e-4
"""Barrier value h [m] down to which a new observation is taken over completely."""
SHARES = (1.0, 0.5, 0.25)
"""Shares s of the new observation that are tried, largest first; then the former estimate stays."""
PERSON_ACCELERATION = 2.0
"""Declared bound of the acceleration of a moving obstacle [m/s²]; the simulated person accelerates with 0.5."""
INTRODUCTION_RATE = 0.02
"""Rate [m/s] at which the margin of an obstacle that moved or appeared grows; every arm here can retreat that fast."""
MAX_TURN = 5e-4
"""Motion of the surface by a turn of the obstacle [m] up to which the former estimate, grown by it, stays valid."""
MAX_HELD_TIME = 1.0
"""Time [s] without an observation after which the former estimate of an obstacle is not used any more."""


@dataclass(frozen=True, slots=True)
class _Estimate:
    """An obstacle as the filter got it at `stamp` [s]; `introduced`: its margin is still growing to its full value."""

    stamp: float
    obstacle: Obstacle
    introduced: bool


class ObstacleEstimates:
    """The estimates in force.

    State: the obstacles as given to the filter, and `begun`, the shortage of the margin [m] by name of the obstacles
    whose introduction began with the last update.
    """

    def __init__(self) -> None:
        """Start without estimates."""
        self._former: dict[str, _Estimate] | None = None
        self.begun: dict[str, float] = {}

    def update(
        self,
        obstacles: Sequence[Obstacle],
        stamp: float,
        *,
        moved: Collection[str],
        h_min: float,
        cover: Callable[[], RobotCover],
        grasped: bool = False,
    ) -> tuple[Obstacle, ...]:
        """The estimates of `obstacles`, observed at `stamp` [s], that the filter gets.

        Observations of the objects in `moved` (just released) are taken over at once, and so are all if `h_min` [m],
        the least barrier value of the last step, exceeds every change. `cover` computes the robot's spheres. `grasped`:
        an object was attached since the last update, so that every margin may be short.
        """
        self.begun = {}
        if self._former is None:
            self._former = {one.name: _Estimate(stamp, one, introduced=False) for one in obstacles}
            return tuple(obstacles)
        priors = {one.name: self._prior(one, stamp) for one in obstacles if one.margin > 0.0}
        new = [one for one in obstacles if one.margin > 0.0 and (grasped or _is_new(one, priors[one.name], moved))]
        changes = [_change(one, prior.obstacle) for one in obstacles if (prior := priors.get(one.name))]
        growing = any(prior.introduced for prior in priors.values() if prior)
        if not new and not growing and h_min > max(changes, default=0.0) + RESERVE:
            chosen = [_Estimate(stamp, one, introduced=False) for one in obstacles]
        else:
            robot, fresh = cover(), {one.name for one in new}
            chosen = [self._estimate(one, stamp, priors.get(one.name), one.name in fresh, robot) for one in obstacles]
        self._former = {one.obstacle.name: one for one in chosen}
        return tuple(one.obstacle for one in chosen)

    def _estimate(
        self, new: Obstacle, stamp: float, prior: _Estimate | None, is_new: bool, robot: RobotCover
    ) -> _Estimate:
        """The estimate for the observation `new`, which replaces the former one if it `is_new`."""
        if robot.is_clear(new, RESERVE):
            return _Estimate(stamp, new, introduced=False)
        if is_new:
            shortage = min(new.margin, RESERVE - robot.clearance(new))
            if shortage <= RESERVE:
                return _Estimate(stamp, new, introduced=False)
            self.begun[new.name] = shortage
            begin = new.margin - shortage - INTRODUCTION_RATE * robot.age
            return _Estimate(stamp, _introduce(new, max(0.0, begin)), introduced=True)
        if prior is None:
            return _Estimate(stamp, new, introduced=False)
        if prior.introduced and prior.obstacle.margin < new.margin:
            grown = _introduce(new, prior.obstacle.margin)
            former = msgspec.structs.replace(grown, pose=prior.obstacle.pose)
            return _Estimate(stamp, _choose(grown, former, robot), introduced=True)
        return _Estimate(stamp, _choose(new, prior.obstacle, robot), introduced=False)

    def _prior(self, new: Obstacle, stamp: float) -> _Estimate | None:
        """The former estimate of the obstacle `new` at `stamp` [s], None if there is none that can be compared."""
        former = (self._former or {}).get(new.name)
        if former is None:
            return None
        age, obstacle = stamp - former.stamp, former.obstacle
        turn = _turn(obstacle, new) if obstacle.shape == new.shape else inf
        if turn > MAX_TURN or not 0.0 <= age <= MAX_HELD_TIME:
            return None
        x, y, z = (p + v * age for p, v in zip(obstacle.pose.position, obstacle.velocity, strict=True))
        margin = obstacle.margin + obstacle.velocity_error * age + _acceleration_error(new, age) + turn
        moved = msgspec.structs.replace(new, pose=Pose((x, y, z), new.pose.quaternion), margin=margin)
        return _Estimate(stamp, moved, former.introduced)


def with_acceleration(obstacle: Obstacle, interval: float) -> Obstacle:
    """A moving `obstacle` whose margin covers its acceleration until the next observation, `interval` [s] later.

    The position differs from the prediction by at most velocity_error t + a t²/2, so that a t²/2 belongs to the margin.
    """
    return msgspec.structs.replace(obstacle, margin=obstacle.margin + _acceleration_error(obstacle, interval))


def _acceleration_error(obstacle: Obstacle, interval: float) -> float:
    """Error of the predicted position [m] after `interval` [s] by the acceleration; 0 for an obstacle at rest."""
    return 0.5 * PERSON_ACCELERATION * interval * interval if obstacle.moves else 0.0


def _is_new(new: Obstacle, prior: _Estimate | None, moved: Collection[str]) -> bool:
    """Whether the observation replaces the former estimate: there is none, or the obstacle moved."""
    return prior is None or new.name in moved or _contradicts(new, prior.obstacle)


def _introduce(new: Obstacle, margin: float) -> Obstacle:
    """The obstacle `new` with a `margin` [m] that grows with `INTRODUCTION_RATE`."""
    return msgspec.structs.replace(new, margin=margin, velocity_error=new.velocity_error + INTRODUCTION_RATE)


def _choose(new: Obstacle, prior: Obstacle, robot: RobotCover) -> Obstacle:
    """The combination of two valid estimates with the largest share of `new` that leaves the margin intact."""
    clearance = robot.clearance(prior)
    if clearance - _change(new, prior) >= RESERVE:
        return new
    needed = min(clearance, RESERVE)
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
    return dist(a.pose.position, b.pose.position)


def _turn(a: Obstacle, b: Obstacle) -> float:
    """Upper bound of the motion [m] of a point of the shape by the turn between two orientations."""
    first, second = a.pose.quaternion, b.pose.quaternion
    if first == second or isinstance(a.shape, Sphere):
        return 0.0
    w, x, y, z = second
    chord = min(dist(first, second), dist(first, (-w, -x, -y, -z)))
    return 4.0 * asin(min(1.0, 0.5 * chord)) * extent(a)


def _change(new: Obstacle, prior: Obstacle) -> float:
    """Largest fall of h [m] by taking over `new`."""
    return _distance(new, prior) + max(0.0, new.margin - prior.margin)
