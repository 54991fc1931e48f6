"""Choice of a home posture with clearance between the links and from the joint limits."""

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
"""Clearance [m] above which the zero posture, or the middle of all ranges, is chosen."""


@dataclass(frozen=True, slots=True)
class HomePosture:
    """A posture (n,) [rad, m] and how it was found."""

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
    """The requested posture; else zero or the middle of all ranges, if they are clear; else the best random posture.

    The clearance of a posture is that of its kept pairs and, if some posture is above the floor, its height above
    `floor_height` [m].

    Raises:
        ConfigurationError: The requested posture is out of range or in self-collision, or every posture is in
            self-collision.
    """
    if requested is not None:
        _require_within_limits(joints, requested)
        gap = float(self_clearances(joints, links, cover, pairs, np.array(requested, float)[None])[0])
        if gap <= 0.0:
            raise ConfigurationError(
                "home", got=f"spheres that overlap by {-gap * 1e3:.0f} mm", allowed="a posture without self-collision"
            )
        return HomePosture(requested, f"given; nearest pair {gap * 1e3:.0f} mm apart")
    low, high = _sampled_ranges(joints)
    margin = 0.1 * (high - low)
    named = {"zero, clear of the limits": np.zeros(len(joints)), "the middle of all ranges": 0.5 * (low + high)}
    postures = np.clip(np.vstack(list(named.values())), low + margin, high - margin)
    gaps = np.minimum(
        self_clearances(joints, links, cover, pairs, postures),
        min_heights(joints, links, cover, postures) - floor_height,
    )
    for q, gap, name in zip(postures, gaps, named, strict=True):
        if gap > MIN_HOME_CLEARANCE:
            return _make_home(q, float(gap), name)
    postures = low + margin + (high - low - 2.0 * margin) * rng.random((N_RANDOM_POSTURES, len(joints)))
    gaps = self_clearances(joints, links, cover, pairs, postures)
    above_floor = np.minimum(gaps, min_heights(joints, links, cover, postures) - floor_height)
    gaps = above_floor if above_floor.max() > 0.0 else gaps
    best = int(np.argmax(gaps))
    if gaps[best] <= 0.0:
        raise ConfigurationError.stating(
            f"The spheres of the links overlap in all of {N_RANDOM_POSTURES} random postures.",
            fix="Use more spheres (--spheres 112, without --quick) or give --home.",
        )
    return _make_home(postures[best], float(gaps[best]), f"the clearest of {N_RANDOM_POSTURES} random postures")


def _make_home(q: Array, gap: float, choice: str) -> HomePosture:
    posture = tuple(round(float(value), 4) for value in q)
    clearance = "no kept pair" if gap == np.inf else f"nearest pair {gap * 1e3:.0f} mm apart"
    return HomePosture(posture, f"{list(posture)}: {choice}; {clearance}")


def _require_within_limits(joints: tuple[Joint, ...], requested: tuple[float, ...]) -> None:
    """Raise `ConfigurationError` unless `requested` has a value within the limits of each joint."""
    if len(requested) != len(joints):
        raise ConfigurationError("home", got=list(requested), allowed=f"{len(joints)} values within the joint limits")
    for joint, value in zip(joints, requested, strict=True):
        if not joint.lower.value < value < joint.upper.value:
            allowed = f"between {joint.lower.value:g} and {joint.upper.value:g} {joint.lower.unit}"
            raise ConfigurationError(f"home of joint {joint.name!r}", got=value, allowed=allowed)


def _sampled_ranges(joints: tuple[Joint, ...]) -> tuple[Array, Array]:
    """Lower and upper ends (n,) of the ranges in which postures are chosen; of a continuous joint -π and π."""
    low = np.array([joint.lower.value for joint in joints])
    high = np.array([joint.upper.value for joint in joints])
    continuous = np.array([joint.kind == "revolute" for joint in joints]) & (high - low > 4.0 * np.pi)
    return np.where(continuous, -np.pi, low), np.where(continuous, np.pi, high)


def min_heights(joints: tuple[Joint, ...], links: tuple[Link, ...], cover: Mapping[str, SphereSet], q: Array) -> Array:
    """Height (m,) [m] of the lowest point of all spheres beyond the link of the first joint, at postures q (m, n)."""
    turns, origins = chain_frames(joints, q)
    lowest = np.full(len(q), np.inf)
    for link in links:
        spheres = cover[link.name]
        if link.frame > min(1, len(joints) - 1) and len(spheres.radii):
            centres = sphere_centres(link, spheres.centres, turns, origins, 0.0)
            lowest = np.minimum(lowest, np.min(centres[:, :, 2] - spheres.radii, axis=1))
    return lowest


def self_clearances(
    joints: tuple[Joint, ...],
    links: tuple[Link, ...],
    cover: Mapping[str, SphereSet],
    pairs: SelfCollisionPairs,
    q: Array,
) -> Array:
    """Smallest gap (m,) [m] of all kept pairs at postures q (m, n); infinite if there is no kept pair."""
    by_name = {link.name: link for link in links}
    gaps = np.full(len(q), np.inf)
    turns, origins = chain_frames(joints, q)
    names = {name for pair in pairs.kept for name in pair}
    centres = {name: sphere_centres(by_name[name], cover[name].centres, turns, origins, 0.0) for name in names}
    for a, b in pairs.kept:
        gaps = np.minimum(gaps, link_clearance(centres[a], centres[b], cover[a].radii, cover[b].radii))
    return gaps
