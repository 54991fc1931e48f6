"""The gain α that a described arm can follow although its parts move on arcs.

Where h is linear in q, braking follows ḣ ≥ −α h for α ≤ α₀ = min_i a_i / v_i. A part of an arm moves on an arc: when
all joints brake together, u falls to zero within T = 1/α₀ and the arm travels u T/2, over which

    h_stop ≥ h + ḣ / (2 α₀) − C / (8 α₀²),    C ≥ |u' ∇²h u|.

A row lets through h = −ḣ/α at least, so that h_stop ≥ 0 at an approach of |ḣ| if

    α ≤ 2 α₀ / (1 + C / (4 α₀ |ḣ|)).

Both are taken at full speed: |ḣ| = STEEP V with V = Σ_i r_i v_i, and C = Σ_j r_j v_j (v_j + 2 Σ_{i<j} v_i), because
|∂²p/∂q_i ∂q_j| ≤ r_j for turns i ≤ j (1 in place of r_j for a slide j, nothing for a slide i). r_i is how far any
sphere of the part comes from the axis of joint i; the part that asks for the least α counts. The distance to a convex
thing is itself convex in p and only adds to h.

Promise: an approach of STEEP V or faster can be stopped by braking alone. Slower, slanting ones need to be steered as
well, and for these nothing is proven here: the adversary of the zoo is what was measured.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.collision_model.coverage import SphereSet
from dualbrain.robots.collision_model.self_collision import chain_frames, random_configurations, sphere_centres
from dualbrain.robots.model import Bound, Joint, Link

Array = NDArray[np.float64]

MIN_BRAKED_SPEED_SHARE = 0.5
"""Share of the full speed V above which an approach is stopped by braking alone."""
N_SAMPLES = 1000


def curvature_limited_gain(
    joints: tuple[Joint, ...], links: tuple[Link, ...], cover: Mapping[str, SphereSet], rng: np.random.Generator
) -> Bound | None:
    """The largest α [1/s] by the equation above; None where α₀ is not above it."""
    straight = min(joint.acceleration.value / joint.velocity.value for joint in joints)
    bends = {
        link.name: path_curvature(joints, reach)
        for link, reach in max_axis_distances(joints, links, cover, rng).items()
    }
    name = max(bends, key=bends.__getitem__, default="")
    share = 2.0 / (1.0 + bends[name] / (4.0 * straight * MIN_BRAKED_SPEED_SHARE)) if name else 1.0
    if share >= 1.0:
        return None
    said = f"curvature of the path of {name!r}: {share:.2f} of min a/v, for approaches of half the full speed or more"
    return Bound(round(share * straight, 4), "1/s", said)


def path_curvature(joints: tuple[Joint, ...], axis_distances: Array) -> float:
    """C / V [1/s] of a part whose spheres come as far as `reach` (k,) [m] from the axes of the first k joints."""
    slides = [joint.kind == "prismatic" for joint in joints]
    v = np.array([joint.velocity.value for joint in joints[: len(axis_distances)]])
    arms = np.where(slides[: len(axis_distances)], 1.0, axis_distances)
    before = np.concatenate([[0.0], np.cumsum(np.where(slides[: len(axis_distances)], 0.0, v))[:-1]])
    own = np.where(slides[: len(axis_distances)], 0.0, v)
    return float(np.sum(arms * v * (own + 2.0 * before)) / np.sum(arms * v))


def max_axis_distances(
    joints: tuple[Joint, ...], links: tuple[Link, ...], cover: Mapping[str, SphereSet], rng: np.random.Generator
) -> dict[Link, Array]:
    """How far the spheres of every moving part come from the axis of each joint before it, over random postures [m]."""
    turns, origins = chain_frames(joints, random_configurations(joints, N_SAMPLES, rng))
    found: dict[Link, Array] = {}
    for link in links:
        if link.frame and len(cover[link.name].radii):
            placed = sphere_centres(link, cover[link.name].centres, turns, origins, 0.0)
            found[link] = np.array(
                [_max_axis_distance(placed, turns[:, i], origins[:, i]) for i in range(1, link.frame + 1)]
            )
    return found


def _max_axis_distance(points: Array, turns: Array, origins: Array) -> float:
    """Largest distance of points (m, b, 3) from the z axes of frames (m, 3, 3) at origins (m, 3) [m]."""
    local = np.einsum("mji,mbj->mbi", turns, points - origins[:, None])
    return float(np.linalg.norm(local[:, :, :2], axis=2).max())
