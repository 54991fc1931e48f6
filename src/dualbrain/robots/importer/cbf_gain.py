"""Class-K gain α of an imported arm, reduced because its links move on arcs.

If h is linear in q, braking satisfies ḣ ≥ −α h for α ≤ α₀ = min_i a_i / v_i. A link of an arm moves on an arc: if all
joints brake together, u falls to zero within T = 1/α₀ and the arm travels u T/2, over which

    h_stop ≥ h + ḣ / (2 α₀) − C / (8 α₀²),    C ≥ |u' ∇²h u|.

A barrier row allows an approach rate ḣ only at h ≥ −ḣ/α, so that h_stop ≥ 0 at the approach rate |ḣ| if

    α ≤ 2 α₀ / (1 + C / (4 α₀ |ḣ|)).

Both quantities are taken at full speed: |ḣ| = s V with s = `MIN_BRAKED_SPEED_SHARE` and V = Σ_i r_i v_i, and
C = Σ_j r_j v_j (v_j + 2 Σ_{i<j} v_i), because |∂²p/∂q_i ∂q_j| ≤ r_j for revolute joints i ≤ j (1 in place of r_j for a
prismatic joint j, 0 for a prismatic joint i). r_i is the largest distance of the spheres of the link from the axis of
joint i; the link with the smallest α counts. The distance to a convex obstacle is convex in p, which only increases h.

Promise: an approach at s V or faster can be stopped by braking alone. A slower, oblique approach also needs steering;
nothing is proven for it, it was only tested against an adversary (experiments/robots/zoo/robot_zoo.py).
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
    """The largest α [1/s] by the equation above; None if it is not below α₀."""
    straight = min(joint.acceleration.value / joint.velocity.value for joint in joints)
    curvatures = {
        link.name: path_curvature(joints, distances)
        for link, distances in max_axis_distances(joints, links, cover, rng).items()
    }
    name = max(curvatures, key=curvatures.__getitem__, default="")
    share = 2.0 / (1.0 + curvatures[name] / (4.0 * straight * MIN_BRAKED_SPEED_SHARE)) if name else 1.0
    if share >= 1.0:
        return None
    provenance = (
        f"curvature of the path of {name!r}: {share:.2f} of min a/v, for approaches of half the full speed or more"
    )
    return Bound(round(share * straight, 4), "1/s", provenance)


def path_curvature(joints: tuple[Joint, ...], axis_distances: Array) -> float:
    """C / V [1/s] of a link whose spheres are at most `axis_distances` (k,) [m] from the axes of the first k joints."""
    moving = joints[: len(axis_distances)]
    prismatic = [joint.kind == "prismatic" for joint in moving]
    v = np.array([joint.velocity.value for joint in moving])
    lever_arms = np.where(prismatic, 1.0, axis_distances)
    rates = np.where(prismatic, 0.0, v)
    earlier_rates = np.concatenate([[0.0], np.cumsum(rates)[:-1]])
    return float(np.sum(lever_arms * v * (rates + 2.0 * earlier_rates)) / np.sum(lever_arms * v))


def max_axis_distances(
    joints: tuple[Joint, ...], links: tuple[Link, ...], cover: Mapping[str, SphereSet], rng: np.random.Generator
) -> dict[Link, Array]:
    """Largest distances (k,) [m] of the sphere centres of every moving link from the axes of the k joints before it.

    The distances are maxima over random postures.
    """
    turns, origins = chain_frames(joints, random_configurations(joints, N_SAMPLES, rng))
    found: dict[Link, Array] = {}
    for link in links:
        if link.frame and len(cover[link.name].radii):
            centres = sphere_centres(link, cover[link.name].centres, turns, origins, 0.0)
            found[link] = np.array(
                [_max_axis_distance(centres, turns[:, i], origins[:, i]) for i in range(1, link.frame + 1)]
            )
    return found


def _max_axis_distance(points: Array, turns: Array, origins: Array) -> float:
    """Largest distance [m] of points (m, b, 3) from the z axes of frames (m, 3, 3) at origins (m, 3)."""
    local = np.einsum("mji,mbj->mbi", turns, points - origins[:, None])
    return float(np.linalg.norm(local[:, :, :2], axis=2).max())
