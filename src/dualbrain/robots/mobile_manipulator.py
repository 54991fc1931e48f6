"""An arm on a base that drives: one chain, one control u = (v, ω, q̇), one filter.

The base's two joints come first, the arm's follow on its frame (frame 2), so that v and ω move every sphere of the
arm as well: in the base's own frame a point p of the arm has the Jacobian [e_x | e_z × p | J_arm(p)], the first two
columns as for a disc of the footprint (`differential_base`). The configuration is (x, y, θ, q).
"""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError
from dualbrain.robots.collision_model.coverage import SphereSet
from dualbrain.robots.collision_model.self_collision import (
    MIN_EXCLUDED_CLEARANCE,
    min_clearances,
    random_configurations,
)
from dualbrain.robots.model import Joint, Link, RobotModel, SelfCollisionPairs, TrackingErrorModel, Vector

Array = NDArray[np.float64]

BASE_JOINTS = 2
"""A base is driven by two numbers, v and ω …"""
BASE_NQ = 3
"""… and stands by three: x, y and heading."""


BASE_GROUP = "base"
"""The group of the links that are the base's own."""


def mount_arm_on_base(
    name: str,
    base: RobotModel,
    arm: RobotModel,
    mount_position: Vector,
    *,
    home: tuple[float, ...],
    tracking: TrackingErrorModel,
    base_lag: float | None,
    n_samples: int,
    rng: np.random.Generator,
) -> RobotModel:
    """`arm` bolted upright to `base` at `at` [m] in the base's frame; what is not the base's is the arm's.

    `home` is x, y, heading and the arm's posture; `base_lag` [s] by how much later than the arm the base follows.
    The tool speed counts against the base. Pairs of the base with the arm's links are chosen over `count` random
    postures; the arm's own stay as they are.

    Raises:
        InvalidSetup: `base` does not drive or carries an arm already, or `arm` drives.
    """
    if not base.is_mobile or base.n != BASE_JOINTS or arm.is_mobile:
        raise ConfigurationError(
            "a mobile manipulator", got=[base.name, arm.name], allowed="a bare base and a bolted arm"
        )
    first = msgspec.structs.replace(arm.joints[0], translation=_add_vectors(mount_position, arm.joints[0].translation))
    joints = (*base.joints, first, *arm.joints[1:])
    links = (*base.links, *(_mount_link(link, mount_position) for link in arm.links))
    spheres = (*base.spheres, *arm.spheres)
    apart = _base_arm_pairs(joints, links, _spheres_by_link(base, arm), base, arm, n_samples, rng)
    return msgspec.structs.replace(
        arm,
        name=name,
        source=f"{base.source}; {arm.source}",
        joints=joints,
        links=links,
        spheres=spheres,
        self_pairs=SelfCollisionPairs((*arm.self_pairs.kept, *apart.kept), (*arm.self_pairs.allowed, *apart.allowed)),
        home=home,
        tracking=tracking,
        base_lag=base_lag,
        base="differential",
        other_drives=(),
    )


def _add_vectors(at: Vector, by: Vector) -> Vector:
    x, y, z = (round(a + b, 12) for a, b in zip(at, by, strict=True))
    return (x, y, z)


def _mount_link(link: Link, at: Vector) -> Link:
    """A link of the arm behind the base's joints; what was bolted down rides on the base."""
    moved = _add_vectors(at, link.translation) if link.frame == 0 else link.translation
    return msgspec.structs.replace(link, frame=link.frame + BASE_JOINTS, translation=moved)


def _spheres_by_link(base: RobotModel, arm: RobotModel) -> dict[str, SphereSet]:
    """Balls of every link, in the link's frame."""
    found: dict[str, SphereSet] = {}
    for robot_model in (base, arm):
        for link in robot_model.links:
            own = [sphere for sphere in robot_model.spheres if sphere.link == link.name]
            centres = np.array([sphere.centre for sphere in own]).reshape(-1, 3)
            found[link.name] = SphereSet(centres, np.array([sphere.radius for sphere in own]))
    return found


def _base_arm_pairs(
    joints: tuple[Joint, ...],
    links: tuple[Link, ...],
    cover: Mapping[str, SphereSet],
    base: RobotModel,
    arm: RobotModel,
    count: int,
    rng: np.random.Generator,
) -> SelfCollisionPairs:
    """Pairs of a link of the base with one of the arm."""
    with_balls = tuple(link for link in links if len(cover[link.name].radii))
    q = random_configurations(joints, count, rng)
    q[:, :BASE_JOINTS] = 0.0  # where the base stands changes nothing between its parts
    least = min_clearances(joints, with_balls, dict(cover), q, (0.0, arm.gripper.opening.value))
    frames = {link.name: link.frame for link in links}
    kept: list[tuple[str, str]] = []
    allowed: list[tuple[str, str, str]] = []
    for low in base.links:
        for link in arm.links:
            gap = least.get((low.name, link.name), np.inf)
            if frames[link.name] - frames[low.name] <= 1:
                allowed.append((low.name, link.name, "adjacent"))
            elif gap > MIN_EXCLUDED_CLEARANCE:
                said = f"never closer than {gap * 1e3:.0f} mm in {count} random configurations"
                allowed.append((low.name, link.name, said))
            else:
                kept.append((low.name, link.name))
    return SelfCollisionPairs(tuple(kept), tuple(allowed))


def extract_arm(robot_model: RobotModel) -> RobotModel:
    """The arm of a mobile manipulator as a bolted body: its frame 0 is the base's frame at the floor."""
    links = tuple(
        msgspec.structs.replace(link, frame=link.frame - BASE_JOINTS)
        for link in robot_model.links
        if link.group != BASE_GROUP
    )
    names = {link.name for link in links}
    return msgspec.structs.replace(
        robot_model,
        joints=robot_model.joints[BASE_JOINTS:],
        links=links,
        home=robot_model.home[BASE_NQ:],
        base="fixed",
        base_lag=None,
        spheres=tuple(sphere for sphere in robot_model.spheres if sphere.link in names),
        self_pairs=SelfCollisionPairs(tuple(pair for pair in robot_model.self_pairs.kept if names >= set(pair)), ()),
    )


def extract_base(robot_model: RobotModel) -> RobotModel:
    """The base of a mobile manipulator, or of a bare base: what rides on its own frame."""
    names = {link.name for link in robot_model.links if link.group == BASE_GROUP}
    return msgspec.structs.replace(
        robot_model,
        joints=robot_model.joints[:BASE_JOINTS],
        links=tuple(link for link in robot_model.links if link.name in names),
        spheres=tuple(sphere for sphere in robot_model.spheres if sphere.link in names),
        self_pairs=SelfCollisionPairs((), ()),
        home=robot_model.home[:BASE_NQ],
    )
