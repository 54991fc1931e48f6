"""Cover of the fingers at every opening, for a robot whose finger opening is not known.

Each finger sphere sweeps a capsule along its slide. Balls at `SEGMENTS` positions of the sweep, enlarged by half a
segment, contain it. Pairs of balls are replaced by their smallest common ball until a link has as many as it had
spheres, and then assigned again to the balls that need to grow least. The model keeps its size and the indices of its
spheres, so a filter step costs the same.
"""

from __future__ import annotations

from functools import lru_cache

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.model import CollisionSphere, Link, RobotModel

Array = NDArray[np.float64]
SEGMENTS = 8
"""Number of segments into which the way of a finger is divided."""
REFINEMENTS, CENTRE_STEPS = 8, 40
"""Number of new assignments of balls, and of steps toward the centre of a common ball in each."""
ROUNDING = 1e-6
"""Enlargement of each sphere [m], so that rounding to single precision keeps the cover."""


def opening_hull(robot_model: RobotModel) -> RobotModel:
    """`robot_model` with fixed fingers whose spheres contain the fingers at every opening from 0 to the largest.

    Links, sphere counts and all other spheres are unchanged. A robot model without sliding links is returned as it is.
    """
    sliding = [link for link in robot_model.links if any(link.slide)]
    if not sliding:
        return robot_model
    covers = {link.name: _cover_link(robot_model, link) for link in sliding}
    spheres = [sphere for sphere in robot_model.spheres if sphere.link not in covers]
    spheres += [sphere for cover in covers.values() for sphere in cover]
    links = tuple(
        msgspec.structs.replace(link, slide=(0.0, 0.0, 0.0)) if link.name in covers else link
        for link in robot_model.links
    )
    return msgspec.structs.replace(robot_model, links=links, spheres=tuple(spheres))


def _cover_link(robot_model: RobotModel, link: Link) -> tuple[CollisionSphere, ...]:
    own = tuple((*sphere.centre, sphere.radius) for sphere in robot_model.spheres if sphere.link == link.name)
    cover = _cover_sweep(own, tuple(link.slide), float(robot_model.gripper.opening.value))
    return tuple(CollisionSphere(link.name, (x, y, z), radius) for x, y, z, radius in cover)


@lru_cache(maxsize=64)
def _cover_sweep(
    own: tuple[tuple[float, float, float, float], ...], slide: tuple[float, ...], opening: float
) -> tuple[tuple[float, float, float, float], ...]:
    """As many spheres (x, y, z, radius) as `own`, which contain `own` moved along `opening` · `slide`."""
    if not own:
        return ()
    spheres, way = np.array(own), opening * np.array(slide)
    parts = (np.arange(SEGMENTS) + 0.5) / SEGMENTS
    centres = (spheres[:, None, :3] + parts[None, :, None] * way).reshape(-1, 3)
    radii = np.repeat(spheres[:, 3] + 0.5 * float(np.linalg.norm(way)) / SEGMENTS, SEGMENTS)
    parts_of_sweep = np.column_stack([centres, radii])
    balls = _refine(parts_of_sweep, _merge(parts_of_sweep, len(own)))
    balls = np.concatenate([balls, np.repeat(balls[-1:], len(own) - len(balls), axis=0)])
    return tuple((float(x), float(y), float(z), float(radius) + ROUNDING) for x, y, z, radius in balls)


def _merge(balls: Array, count: int) -> Array:
    """At most `count` balls whose union contains `balls` (k, 4), by merging the pair with the smallest common ball."""
    balls = balls.copy()
    alive = np.ones(len(balls), bool)
    radii = _common_radii(balls, balls)
    np.fill_diagonal(radii, np.inf)
    while alive.sum() > count:
        i, j = np.unravel_index(np.argmin(radii), radii.shape)
        balls[i] = _common_ball(balls[i], balls[j])
        alive[j] = False
        radii[j, :] = radii[:, j] = np.inf
        row = np.where(alive, _common_radii(balls[i][None], balls)[0], np.inf)
        row[i] = np.inf
        radii[i, :] = radii[:, i] = row
    return balls[alive]


def _refine(parts: Array, balls: Array) -> Array:
    """`balls` (b, 4), which contain `parts` (p, 4), after the refinements; those with the smallest total volume."""
    best = balls
    for _ in range(REFINEMENTS):
        reach = np.linalg.norm(parts[None, :, :3] - balls[:, None, :3], axis=2) + parts[None, :, 3]
        nearest = np.argmin(reach - balls[:, 3:], axis=0)
        members = np.arange(len(balls))[:, None] == nearest
        balls = _enclose(parts, members[members.any(axis=1)])
        if np.sum(balls[:, 3] ** 3) < np.sum(best[:, 3] ** 3):
            best = balls
    return best


def _enclose(parts: Array, members: NDArray[np.bool_]) -> Array:
    """A ball (b, 4) around the marked `parts` (p, 4) of every row of `members` (b, p) (Badoiu and Clarkson, 2003)."""
    centres = members @ parts[:, :3] / members.sum(axis=1, keepdims=True)
    for step in range(CENTRE_STEPS):
        reach = np.linalg.norm(parts[None, :, :3] - centres[:, None], axis=2) + parts[None, :, 3]
        farthest = np.argmax(np.where(members, reach, -np.inf), axis=1)
        centres = centres + (parts[farthest, :3] - centres) / (step + 2.0)
    reach = np.linalg.norm(parts[None, :, :3] - centres[:, None], axis=2) + parts[None, :, 3]
    return np.column_stack([centres, np.max(np.where(members, reach, -np.inf), axis=1)])


def _common_radii(one: Array, other: Array) -> Array:
    """Radii (a, b) of the smallest balls that contain each ball of `one` (a, 4) and each of `other` (b, 4)."""
    gap = np.linalg.norm(one[:, None, :3] - other[None, :, :3], axis=2)
    larger = np.maximum(one[:, None, 3], other[None, :, 3])
    return np.maximum(larger, 0.5 * (gap + one[:, None, 3] + other[None, :, 3]))


def _common_ball(one: Array, other: Array) -> Array:
    """The smallest ball (4,) that contains two balls (4,)."""
    if one[3] < other[3]:
        one, other = other, one
    way = other[:3] - one[:3]
    gap = float(np.linalg.norm(way))
    if gap + other[3] <= one[3]:
        return one
    radius = 0.5 * (gap + one[3] + other[3])
    return np.append(one[:3] + way * ((radius - one[3]) / gap), radius)
