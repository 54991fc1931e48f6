"""A posture to start from: far from the robot's own parts and from joint limits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError
from dualbrain.robots.collision_model.coverage import SphereSet
from dualbrain.robots.collision_model.self_collision import chain_frames, link_clearance, sphere_centres
from dualbrain.robots.model import Joint, Link, SelfCollisionPairs

Array = NDArray[np.float64]

N_RANDOM_POSTURES = 4000
MIN_HOME_CLEARANCE = 0.02
"""The middle of all ranges, or zero, is taken when no pair comes nearer than this [m]."""


@dataclass(frozen=True, slots=True)
class HomePosture:
    """A posture (n,) and how it was found."""

    posture: tuple[float, ...]
    provenance: str


def find_home_posture(
    joints: tuple[Joint, ...],
    links: tuple[Link, ...],
    cover: Mapping[str, SphereSet],
    pairs: SelfCollisionPairs,
    requested: tuple[float, ...] | None,
    floor_height: float,
    rng: np.random.Generator,
) -> HomePosture:
    """The posture that was given, else zero or mid-range if they are free, else the freest of many random ones.

    Free also means above `floor` [m], the height at which the robot stands, if some posture is.

    Raises:
        InvalidSetup: the given one is out of range or in self-collision, or none is free.
    """
    low, high = _joint_ranges(joints)
    if requested is not None:
        q = np.array(requested, float)
        if q.shape != low.shape or not np.all((q > low) & (q < high)):
            raise ConfigurationError(
                "home", got=list(requested), allowed=f"{len(joints)} values within the joint limits"
            )
        gap = float(self_clearances(joints, links, cover, pairs, q[None])[0])
        if gap <= 0.0:
            raise ConfigurationError(
                "home", got=f"spheres overlap by {-gap * 1e3:.0f} mm", allowed="free of self-collision"
            )
        return HomePosture(requested, f"given; nearest pair {gap * 1e3:.0f} mm apart")
    margin = 0.1 * (high - low)
    firsts = np.clip(np.vstack([np.zeros(len(joints)), 0.5 * (low + high)]), low + margin, high - margin)
    gaps = np.minimum(
        self_clearances(joints, links, cover, pairs, firsts), min_heights(joints, links, cover, firsts) - floor_height
    )
    for q, gap, said in zip(firsts, gaps, ("zero, kept from limits", "the middle of all ranges"), strict=True):
        if gap > MIN_HOME_CLEARANCE:
            return _make_home(q, float(gap), said)
    tries = low + margin + (high - low - 2.0 * margin) * rng.random((N_RANDOM_POSTURES, len(joints)))
    gaps = self_clearances(joints, links, cover, pairs, tries)
    above = np.minimum(gaps, min_heights(joints, links, cover, tries) - floor_height)
    gaps = above if above.max() > 0.0 else gaps
    best = int(np.argmax(gaps))
    if gaps[best] <= 0.0:
        raise ConfigurationError(
            "self-collision",
            got=f"spheres overlap in all of {N_RANDOM_POSTURES} random postures",
            allowed="a posture without",
            fix="Use more spheres (--spheres 112, without --quick) or give --home.",
        )
    return _make_home(tries[best], float(gaps[best]), f"the freest of {N_RANDOM_POSTURES} random postures")


def _make_home(q: Array, gap: float, said: str) -> HomePosture:
    posture = tuple(round(float(value), 4) for value in q)
    away = "no pair to keep" if gap == np.inf else f"nearest pair {gap * 1e3:.0f} mm apart"
    return HomePosture(posture, f"{list(posture)}: {said}; {away}")


def _joint_ranges(joints: tuple[Joint, ...]) -> tuple[Array, Array]:
    """Ranges (n,), of a turn no more than once around."""
    low = np.array([joint.lower.value for joint in joints])
    high = np.array([joint.upper.value for joint in joints])
    endless = np.array([joint.kind == "revolute" for joint in joints]) & (high - low > 4.0 * np.pi)
    return np.where(endless, -np.pi, low), np.where(endless, np.pi, high)


def min_heights(joints: tuple[Joint, ...], links: tuple[Link, ...], cover: Mapping[str, SphereSet], q: Array) -> Array:
    """Height [m] of the lowest point of all spheres beyond the first joint's link, at postures q (m, n), (m,)."""
    turns, origins = chain_frames(joints, q)
    lowest = np.full(len(q), np.inf)
    for link in links:
        balls = cover[link.name]
        if link.frame > min(1, len(joints) - 1) and len(balls.radii):
            placed = sphere_centres(link, balls.centres, turns, origins, 0.0)
            lowest = np.minimum(lowest, np.min(placed[:, :, 2] - balls.radii, axis=1))
    return lowest


def self_clearances(
    joints: tuple[Joint, ...],
    links: tuple[Link, ...],
    cover: Mapping[str, SphereSet],
    pairs: SelfCollisionPairs,
    q: Array,
) -> Array:
    """Smallest gap [m] of all kept pairs at postures q (m, n), (m,)."""
    by_name = {link.name: link for link in links}
    gaps = np.full(len(q), np.inf)
    turns, origins = chain_frames(joints, q)
    used = {name for pair in pairs.kept for name in pair}
    at = {name: sphere_centres(by_name[name], cover[name].centres, turns, origins, 0.0) for name in used}
    for a, b in pairs.kept:
        gaps = np.minimum(gaps, link_clearance(at[a], at[b], cover[a].radii, cover[b].radii))
    return gaps
