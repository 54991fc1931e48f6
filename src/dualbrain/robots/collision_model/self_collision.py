"""Choice of the self-collision pairs of a packaged robot, with a reason for every excluded pair.

The numpy kinematics of this module generates data only; at run time the kinematics of the kernel is used.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.collision_model.coverage import SphereSet
from dualbrain.robots.model import Joint, Link, SelfCollisionPairs

Array = NDArray[np.float64]

MIN_EXCLUDED_CLEARANCE = 0.030
"""A pair whose clearance is above this [m] in all sampled configurations is excluded."""


def unit_quaternion_to_matrix(quaternion: tuple[float, float, float, float]) -> Array:
    """Rotation matrix (3, 3) of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def chain_frames(joints: tuple[Joint, ...], q: Array) -> tuple[Array, Array]:
    """Chain frames of a batch of configurations q (m, n): rotations (m, n + 1, 3, 3), origins (m, n + 1, 3) [m].

    T_i = T_(i-1) [R_i t_i; 0 1] Rot_z(q_i), with Trans_z(q_i) for a prismatic joint; frame 0 is the base.
    """
    m, n = q.shape
    turns, origins = np.empty((m, n + 1, 3, 3)), np.zeros((m, n + 1, 3))
    turns[:, 0] = np.eye(3)
    for i, joint in enumerate(joints):
        prismatic = joint.kind == "prismatic"
        angle, zero = np.zeros(m) if prismatic else q[:, i], np.zeros(m)
        c, s = np.cos(angle), np.sin(angle)
        about_z = np.stack([c, -s, zero, s, c, zero, zero, zero, zero + 1], axis=1).reshape(m, 3, 3)
        origins[:, i + 1] = origins[:, i] + turns[:, i] @ np.array(joint.translation)
        turns[:, i + 1] = turns[:, i] @ unit_quaternion_to_matrix(joint.quaternion) @ about_z
        if prismatic:
            origins[:, i + 1] += q[:, i, None] * turns[:, i + 1, :, 2]
    return turns, origins


def sphere_centres(link: Link, centres: Array, turns: Array, origins: Array, opening: float) -> Array:
    """World positions (m, b, 3) of sphere centres (b, 3) given in the frame of `link`, at finger `opening` [m]."""
    local = (centres + opening * np.array(link.slide)) @ unit_quaternion_to_matrix(link.quaternion).T + np.array(
        link.translation
    )
    return np.einsum("mij,bj->mbi", turns[:, link.frame], local) + origins[:, link.frame, None]


def link_clearance(a: Array, b: Array, radii_a: Array, radii_b: Array) -> Array:
    """Smallest gap [m] between two sets of spheres with world centres (m, b, 3), (m,); negative for an overlap."""
    squared = np.sum(a**2, axis=2)[:, :, None] + np.sum(b**2, axis=2)[:, None] - 2 * a @ b.transpose(0, 2, 1)
    gaps = np.sqrt(np.maximum(squared, 0)) - (radii_a[:, None] + radii_b[None])
    return np.min(gaps, axis=(1, 2))


def random_configurations(joints: tuple[Joint, ...], n_samples: int, rng: np.random.Generator) -> Array:
    """Random configurations (n_samples, n), uniform within the joint limits [rad, m]."""
    low = np.array([joint.lower.value for joint in joints])
    high = np.array([joint.upper.value for joint in joints])
    return low + (high - low) * rng.random((n_samples, len(joints)))


def min_clearances(
    joints: tuple[Joint, ...],
    links: tuple[Link, ...],
    cover: dict[str, SphereSet],
    q: Array,
    openings: tuple[float, ...],
) -> dict[tuple[str, str], float]:
    """Smallest gap [m] of every pair of links over configurations q (m, n) and finger `openings` [m]."""
    clearances = {(a.name, b.name): np.inf for a, b in combinations(links, 2)}
    for batch in np.array_split(q, max(1, len(q) // 2000)):
        turns, origins = chain_frames(joints, batch)
        for opening in openings:
            centres = {
                link.name: sphere_centres(link, cover[link.name].centres, turns, origins, opening) for link in links
            }
            for (a, b), previous in clearances.items():
                gap = link_clearance(centres[a], centres[b], cover[a].radii, cover[b].radii)
                clearances[a, b] = min(previous, float(gap.min()))
    return clearances


def choose_pairs(
    joints: tuple[Joint, ...],
    links: tuple[Link, ...],
    cover: dict[str, SphereSet],
    *,
    allowed_by_design: dict[tuple[str, str], str],
    n_samples: int,
    rng: np.random.Generator,
    opening: float,
) -> SelfCollisionPairs:
    """Keep every pair of links that is neither adjacent, nor in `allowed_by_design`, nor always clear of each other.

    Two links are adjacent if they are attached to the same or to consecutive chain frames. A pair is always clear if
    its smallest gap over `n_samples` random configurations, with the fingers closed and open by `opening` [m] each, is
    above `MIN_EXCLUDED_CLEARANCE`; its reason contains that gap.
    """
    q = random_configurations(joints, n_samples, rng)
    kept: list[tuple[str, str]] = []
    allowed: list[tuple[str, str, str]] = []
    for (a, b), gap in min_clearances(joints, links, cover, q, (0.0, opening)).items():
        first, second = (next(link for link in links if link.name == name) for name in (a, b))
        reason = allowed_by_design.get((a, b), "adjacent" if abs(first.frame - second.frame) <= 1 else "")
        if not reason and gap > MIN_EXCLUDED_CLEARANCE:
            reason = f"never closer than {gap * 1e3:.0f} mm in {n_samples} random configurations"
        if reason:
            allowed.append((a, b, reason))
        else:
            kept.append((a, b))
    return SelfCollisionPairs(tuple(kept), tuple(allowed))
