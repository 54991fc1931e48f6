"""Which pairs of links are kept apart, where nobody has looked at the robot beforehand.

A pair is left out only with its reason: links on the same or on consecutive frames; spheres that never came near in all
samples; links a joint or two apart whose spheres overlap but whose shapes stay apart over a whole grid of the joints
between them (their relative pose depends on nothing else); and spheres that overlap wherever the joints stand, so that
no control could part them. All others are kept.
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
"""Pairs with so many joints between them are looked at shape by shape, at so many values of each joint."""
MIN_SHAPE_CLEARANCE = 0.008
"""Shapes that stay this far apart [m] over the grid need no row."""
ALWAYS_OVERLAPPING_SHARE = 0.98
"""Share of configurations in which spheres must overlap to count as always overlapping."""
MIN_KEPT_CLEARANCE = 0.02
"""A kept pair that is nowhere farther apart than this [m] is pressed: its spheres leave the robot no room to move."""


@dataclass(frozen=True, slots=True)
class SampledPairs:
    """Every pair, kept or with its reason, and the links of kept pairs that are pressed."""

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
    """Every pair, looked at in `count` random postures; `surfaces` are points (p, 3) on each link, in its frame."""
    q = random_configurations(joints, n_samples, rng)
    gaps = _gaps(joints, links, cover, q)
    kept: list[tuple[str, str]] = []
    allowed: list[tuple[str, str, str]] = []
    pressed: set[str] = set()
    for (a, b), gap in gaps.items():
        reason = _exclusion_reason(a, b, gap, n_samples) or _shape_clearance_reason(joints, a, b, gap, surfaces)
        if not reason and float(np.mean(gap < 0.0)) > ALWAYS_OVERLAPPING_SHARE:
            deepest = -float(gap.max()) * 1e3
            reason = f"spheres overlap in all of {n_samples} random configurations, by {deepest:.0f} mm or more"
        if reason:
            allowed.append((a.name, b.name, reason))
        else:
            kept.append((a.name, b.name))
            pressed |= {a.name, b.name} if gap.max() < MIN_KEPT_CLEARANCE else set()
    return SampledPairs(SelfCollisionPairs(tuple(kept), tuple(allowed)), frozenset(pressed))


def _gaps(
    joints: tuple[Joint, ...], links: tuple[Link, ...], cover: Mapping[str, SphereSet], q: Array
) -> dict[tuple[Link, Link], Array]:
    """Gap [m] of every pair of links that have spheres, at every configuration."""
    covered = [link for link in links if len(cover[link.name].radii)]
    found: dict[tuple[Link, Link], list[Array]] = {pair: [] for pair in combinations(covered, 2)}
    for batch in np.array_split(q, max(1, len(q) // 1000)):
        turns, origins = chain_frames(joints, batch)
        at = {link: sphere_centres(link, cover[link.name].centres, turns, origins, 0.0) for link in covered}
        for (a, b), gaps in found.items():
            near = abs(a.frame - b.frame) <= 1
            gaps.append(
                np.zeros(len(batch)) if near else link_clearance(at[a], at[b], cover[a.name].radii, cover[b.name].radii)
            )
    return {pair: np.concatenate(gaps) for pair, gaps in found.items()}


def _exclusion_reason(a: Link, b: Link, gap: Array, count: int) -> str:
    if a.frame == b.frame:
        return "rigidly connected"
    if abs(a.frame - b.frame) == 1:
        return "adjacent"
    if gap.min() > MIN_EXCLUDED_CLEARANCE:
        return f"never closer than {gap.min() * 1e3:.0f} mm in {count} random configurations"
    return ""


def _shape_clearance_reason(
    joints: tuple[Joint, ...], a: Link, b: Link, gap: Array, surfaces: Mapping[str, Array]
) -> str:
    """The reason why overlapping spheres of near links are no danger, or nothing."""
    first, second = sorted((a, b), key=lambda link: link.frame)
    between = second.frame - first.frame
    if between not in GRID_POINTS or gap.min() > 0.0:
        return ""
    middle = joints[first.frame : second.frame]
    axes = [np.linspace(*_range(joint), GRID_POINTS[between]) for joint in middle]
    q = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, between)
    turns, origins = chain_frames(middle, q)
    tree = import_optional("scipy.spatial").cKDTree(_points_in_chain_frame(first, surfaces[first.name]))
    local, least = _points_in_chain_frame(second, surfaces[second.name]), np.inf
    for turn, origin in zip(turns[:, -1], origins[:, -1], strict=True):
        least = min(least, float(tree.query(local @ turn.T + origin)[0].min()))
        if least < MIN_SHAPE_CLEARANCE:
            return ""
    names = ", ".join(joint.name for joint in middle)
    return f"shapes stay {least * 1e3:.0f} mm apart on a grid of {len(q)} positions of {names} (spheres overlap)"


def _range(joint: Joint) -> tuple[float, float]:
    """The joint's range, of a turn no more than once around."""
    low, high = joint.lower.value, joint.upper.value
    return (-np.pi, np.pi) if joint.kind == "revolute" and high - low > 2.0 * np.pi else (low, high)


def _points_in_chain_frame(link: Link, points: Array) -> Array:
    """Points of `link` in the chain frame it rides on."""
    turns, origins = np.eye(3)[None, None], np.zeros((1, 1, 3))
    return sphere_centres(
        Link(name="", frame=0, group="", translation=link.translation, quaternion=link.quaternion),
        points,
        turns,
        origins,
        0.0,
    )[0]
