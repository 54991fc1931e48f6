"""Parts of a packaged robot that are made from its fitted spheres: records, link pairs, and lines of progress."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dualbrain.robots.assets.meshes import Mesh
from dualbrain.robots.collision_model.polytope import sample_surface
from dualbrain.robots.collision_model.self_collision_sampling import sample_pairs
from dualbrain.robots.collision_model.sphere_budget import LinkFit
from dualbrain.robots.model import Bound, CollisionSphere, Gripper, Joint, Link, SelfCollisionPairs

N_SURFACE_POINTS, N_CONFIGURATIONS = 1500, 100_000
"""Number of surface points of each link, and of random configurations, for the choice of link pairs."""


def no_gripper(reason: str) -> Gripper:
    """A gripper that no skill can use, with the reason as its provenance."""
    force = Bound(0.0, "N", reason)
    return Gripper(
        opening=Bound(0.0, "m", reason), force=force, force_min=force, pad_below_tool=0.0, finger_thickness=0.0
    )


def fitted_spheres(fits: Mapping[str, LinkFit]) -> tuple[CollisionSphere, ...]:
    """The spheres as records; `fit_links` has rounded them to 10 µm."""
    found: list[CollisionSphere] = []
    for name, fit in fits.items():
        for centre, radius in zip(fit.spheres.centres, fit.spheres.radii, strict=True):
            x, y, z = (round(float(value), 5) + 0.0 for value in centre)
            found.append(CollisionSphere(name, (x, y, z), round(float(radius), 5)))
    return tuple(found)


def fitted_pairs(
    joints: tuple[Joint, ...],
    links: tuple[Link, ...],
    fits: Mapping[str, LinkFit],
    shapes: Mapping[str, Sequence[Mesh]],
    seed: int,
) -> SelfCollisionPairs:
    """The link pairs that are kept apart, from random configurations."""
    rng = np.random.default_rng([seed, len(shapes)])
    surfaces = {
        name: np.vstack([sample_surface(mesh, N_SURFACE_POINTS // len(meshes), rng) for mesh in meshes])
        for name, meshes in shapes.items()
    }
    cover = {name: fit.spheres for name, fit in fits.items()}
    return sample_pairs(joints, links, cover, surfaces, n_samples=N_CONFIGURATIONS, rng=rng).pairs


def describe_fit(name: str, fit: LinkFit) -> str:
    """One line of progress on the spheres of a link."""
    return (
        f"{name}: {len(fit.spheres.radii)} spheres on {fit.n_parts} convex parts, stand-off mean {fit.mean * 1e3:.1f} "
        f"mm, 95 % {fit.p95 * 1e3:.1f} mm, worst {fit.worst * 1e3:.1f} mm"
    )
