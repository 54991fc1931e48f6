"""Automatic choice of the self-collision pairs of an imported robot.

A pair is excluded only for one of these reasons, which is recorded: the links are on the same or on consecutive frames;
the spheres are far apart in all samples; the links are two or three joints apart and their spheres overlap, but their
shapes are apart on a grid of the joints between them (on which alone their relative pose depends); or the spheres
overlap in practically all configurations, so that no control could separate them. All other pairs are kept.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.collision_model.coverage import SphereSet
from dualbrain.robots.collision_model.self_collision import (
    MIN_EXCLUDED_CLEARANCE,
    chain_frames,
    link_clearance,
    random_configurations,
    sphere_centres,
)
from dualbrain.robots.model import Joint, Link, SelfCollisionPairs
from dualbrain.robots.optional_imports import import_optional

Array = NDArray[np.float64]

GRID_POINTS = {2: 24, 3: 10}
"""Grid points per joint for the comparison of shapes, by the number of joints between the links of a pair."""
MIN_SHAPE_CLEARANCE = 0.008
"""Clearance of the shapes [m] on the whole grid above which a pair is excluded."""
ALWAYS_OVERLAPPING_SHARE = 0.98
"""Share of configurations above which overlapping spheres count as always overlapping."""
MIN_KEPT_CLEARANCE = 0.02
"""A kept pair that is nowhere farther apart than this [m] is congested: its spheres leave no room to move."""


@dataclass(frozen=True, slots=True)
class SampledPairs:
    """All pairs, kept or excluded with the reason, and the links of congested pairs."""

    pairs: SelfCollisionPairs
    congested_links: frozenset[str]


def sample_pairs(
    joints: tuple[Joint, ...],
    links: tuple[Link, ...],
    cover: Mapping[str, SphereSet],
    surfaces: Mapping[str, Array],
    *,
    n_samples: int,
    rng: np.random.Generator,
) -> SampledPairs:
    """The choice over `n_samples` random postures; `surfaces` are points (p, 3) on each link, in the link frame."""
    q = random_configurations(joints, n_samples, rng)
    kept: list[tuple[str, str]] = []
    allowed: list[tuple[str, str, str]] = []
    congested: set[str] = set()
    for (a, b), gap in _gaps(joints, links, cover, q).items():
        reason = _exclusion_reason(a, b, gap, n_samples) or _shape_clearance_reason(joints, a, b, gap, surfaces)
        if not reason and float(np.mean(gap < 0.0)) > ALWAYS_OVERLAPPING_SHARE:
            deepest = -float(gap.max()) * 1e3
            reason = f"spheres overlap in all of {n_samples} random configurations, by {deepest:.0f} mm or more"
        if reason:
            allowed.append((a.name, b.name, reason))
        else:
            kept.append((a.name, b.name))
            congested |= {a.name, b.name} if gap.max() < MIN_KEPT_CLEARANCE else set()
    return SampledPairs(SelfCollisionPairs(tuple(kept), tuple(allowed)), frozenset(congested))


def _gaps(
    joints: tuple[Joint, ...], links: tuple[Link, ...], cover: Mapping[str, SphereSet], q: Array
) -> dict[tuple[Link, Link], Array]:
    """Gap (m,) [m] of every pair of links with spheres at configurations q (m, n); 0 for adjacent links."""
    covered = [link for link in links if len(cover[link.name].radii)]
    found: dict[tuple[Link, Link], list[Array]] = {pair: [] for pair in combinations(covered, 2)}
    for batch in np.array_split(q, max(1, len(q) // 1000)):
        turns, origins = chain_frames(joints, batch)
        centres = {link: sphere_centres(link, cover[link.name].centres, turns, origins, 0.0) for link in covered}
        for (a, b), gaps in found.items():
            if abs(a.frame - b.frame) <= 1:
                gaps.append(np.zeros(len(batch)))
            else:
                gaps.append(link_clearance(centres[a], centres[b], cover[a.name].radii, cover[b.name].radii))
    return {pair: np.concatenate(gaps) for pair, gaps in found.items()}


def _exclusion_reason(a: Link, b: Link, gap: Array, n_samples: int) -> str:
    """The reason for excluding a pair by its frames or its sampled gaps (m,) [m]; "" if there is none."""
    if a.frame == b.frame:
        return "rigidly connected"
    if abs(a.frame - b.frame) == 1:
        return "adjacent"
    if gap.min() > MIN_EXCLUDED_CLEARANCE:
        return f"never closer than {gap.min() * 1e3:.0f} mm in {n_samples} random configurations"
    return ""


def _shape_clearance_reason(
    joints: tuple[Joint, ...], a: Link, b: Link, gap: Array, surfaces: Mapping[str, Array]
) -> str:
    """The reason for excluding a pair whose spheres overlap but whose shapes do not; "" if there is none."""
    first, second = sorted((a, b), key=lambda link: link.frame)
    n_joints = second.frame - first.frame
    if n_joints not in GRID_POINTS or gap.min() > 0.0:
        return ""
    between = joints[first.frame : second.frame]
    axes = [np.linspace(*_range(joint), GRID_POINTS[n_joints]) for joint in between]
    q = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, n_joints)
    turns, origins = chain_frames(between, q)
    tree = import_optional("scipy.spatial").cKDTree(_points_in_chain_frame(first, surfaces[first.name]))
    points, clearance = _points_in_chain_frame(second, surfaces[second.name]), np.inf
    for turn, origin in zip(turns[:, -1], origins[:, -1], strict=True):
        clearance = min(clearance, float(tree.query(points @ turn.T + origin)[0].min()))
        if clearance < MIN_SHAPE_CLEARANCE:
            return ""
    names = ", ".join(joint.name for joint in between)
    return f"shapes stay {clearance * 1e3:.0f} mm apart on a grid of {len(q)} positions of {names} (spheres overlap)"


def _range(joint: Joint) -> tuple[float, float]:
    """The range of the joint [rad or m]; of a revolute joint at most one turn."""
    low, high = joint.lower.value, joint.upper.value
    return (-np.pi, np.pi) if joint.kind == "revolute" and high - low > 2.0 * np.pi else (low, high)


def _points_in_chain_frame(link: Link, points: Array) -> Array:
    """Points (p, 3) of `link` in the chain frame to which it is attached."""
    turns, origins = np.eye(3)[None, None], np.zeros((1, 1, 3))
    return sphere_centres(
        Link(name="", frame=0, group="", translation=link.translation, quaternion=link.quaternion),
        points,
        turns,
        origins,
        0.0,
    )[0]
