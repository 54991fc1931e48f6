"""Mobile manipulator: an arm on a mobile base as one kinematic chain with one control u = (v, ω, q̇) and one filter.

The two joints of the base come first, and the joints of the arm follow on frame 2, so that v and ω also move every
sphere of the arm. In the frame of the base a point p of the arm has the Jacobian [e_x | e_z × p | J_arm(p)], whose
first two columns are those of a disc of the footprint (`differential_drive`). The configuration is (x, y, θ, q).
"""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
import numpy as np

from dualbrain.errors import ConfigurationError
from dualbrain.robots.collision_model.coverage import SphereSet
from dualbrain.robots.collision_model.self_collision import (
    MIN_EXCLUDED_CLEARANCE,
    min_clearances,
    random_configurations,
)
from dualbrain.robots.model import (
    DynamicModel,
    ForceSensing,
    Joint,
    Link,
    RobotModel,
    SelfCollisionPairs,
    TrackingErrorModel,
    Vector,
)

BASE_JOINTS = 2
"""Number of controls of a base: v and ω."""
BASE_NQ = 3
"""Number of configuration variables of a base: x, y and heading."""
NO_BASE_VALUES = (0.0,) * BASE_JOINTS
"""Entries of the joints of a base, whose motors have no dynamic model and measure no torque."""
BASE_GROUP = "base"
"""Group of the links of the base."""


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
    """Robot model of `arm` bolted upright to `base` at `mount_position` [m] in the frame of the base.

    `home` is x, y, heading and the posture of the arm; `base_lag` [s] is the additional lag of the base. The limit of
    the tool speed is relative to the base. Self-collision pairs of a link of the base with a link of the arm are chosen
    from `n_samples` random postures; the pairs of the arm are kept.

    Raises:
        ConfigurationError: `base` is not mobile or has an arm already, or `arm` is mobile.
    """
    if not base.is_mobile or base.n != BASE_JOINTS or arm.is_mobile:
        raise ConfigurationError.stating(
            f"Robot {arm.name!r} on base {base.name!r} is not a mobile manipulator.",
            fix="Combine a mobile base without an arm and an arm with a fixed base.",
        )
    first = msgspec.structs.replace(arm.joints[0], translation=_add_vectors(mount_position, arm.joints[0].translation))
    joints = (*base.joints, first, *arm.joints[1:])
    links = (*base.links, *(_mount_link(link, mount_position) for link in arm.links))
    spheres = (*base.spheres, *arm.spheres)
    pairs = _base_arm_pairs(joints, links, _spheres_by_link(base, arm), base, arm, n_samples, rng)
    return msgspec.structs.replace(
        arm,
        name=name,
        source=f"{base.source}; {arm.source}",
        joints=joints,
        links=links,
        spheres=spheres,
        self_pairs=SelfCollisionPairs((*arm.self_pairs.kept, *pairs.kept), (*arm.self_pairs.allowed, *pairs.allowed)),
        home=home,
        tracking=tracking,
        base_lag=base_lag,
        base="differential",
        other_drives=(),
        dynamics=_mount_dynamics(arm.dynamics),
        force_sensing=_mount_sensing(arm.force_sensing),
    )


def _add_vectors(first: Vector, second: Vector) -> Vector:
    x, y, z = (round(a + b, 12) for a, b in zip(first, second, strict=True))
    return (x, y, z)


def _mount_link(link: Link, mount_position: Vector) -> Link:
    """A link of the arm behind the joints of the base; a link that was fixed to the world moves with the base."""
    translation = _add_vectors(mount_position, link.translation) if link.frame == 0 else link.translation
    return msgspec.structs.replace(link, frame=link.frame + BASE_JOINTS, translation=translation)


def _mount_dynamics(dynamics: DynamicModel | None) -> DynamicModel | None:
    """The masses of the arm behind the joints of the base."""
    if dynamics is None:
        return None
    return msgspec.structs.replace(
        dynamics,
        bodies=tuple(msgspec.structs.replace(body, frame=body.frame + BASE_JOINTS) for body in dynamics.bodies),
        rotor_inertia=(*NO_BASE_VALUES, *dynamics.rotor_inertia),
        damping=(*NO_BASE_VALUES, *dynamics.damping),
    )


def _mount_sensing(sensing: ForceSensing | None) -> ForceSensing | None:
    """The force sensing of the arm; the motors of the base measure none."""
    if sensing is None or sensing.kind == "wrist_wrench":
        return sensing
    return msgspec.structs.replace(
        sensing, noise=(*NO_BASE_VALUES, *sensing.noise), accuracy=(*NO_BASE_VALUES, *sensing.accuracy)
    )


def _spheres_by_link(base: RobotModel, arm: RobotModel) -> dict[str, SphereSet]:
    """Collision spheres of every link, in the frame of the link."""
    found: dict[str, SphereSet] = {}
    for robot_model in (base, arm):
        for link in robot_model.links:
            spheres = [sphere for sphere in robot_model.spheres if sphere.link == link.name]
            centres = np.array([sphere.centre for sphere in spheres]).reshape(-1, 3)
            found[link.name] = SphereSet(centres, np.array([sphere.radius for sphere in spheres]))
    return found


def _base_arm_pairs(
    joints: tuple[Joint, ...],
    links: tuple[Link, ...],
    cover: Mapping[str, SphereSet],
    base: RobotModel,
    arm: RobotModel,
    n_samples: int,
    rng: np.random.Generator,
) -> SelfCollisionPairs:
    """Pairs of a link of the base with a link of the arm."""
    covered_links = tuple(link for link in links if len(cover[link.name].radii))
    q = random_configurations(joints, n_samples, rng)
    q[:, :BASE_JOINTS] = 0.0  # clearances within the robot do not depend on the pose of the base
    clearances = min_clearances(joints, covered_links, dict(cover), q, (0.0, arm.gripper.opening.value))
    frames = {link.name: link.frame for link in links}
    kept: list[tuple[str, str]] = []
    allowed: list[tuple[str, str, str]] = []
    for base_link in base.links:
        for link in arm.links:
            gap = clearances.get((base_link.name, link.name), np.inf)
            if frames[link.name] - frames[base_link.name] <= 1:
                allowed.append((base_link.name, link.name, "adjacent"))
            elif gap > MIN_EXCLUDED_CLEARANCE:
                reason = f"never closer than {gap * 1e3:.0f} mm in {n_samples} random configurations"
                allowed.append((base_link.name, link.name, reason))
            else:
                kept.append((base_link.name, link.name))
    return SelfCollisionPairs(tuple(kept), tuple(allowed))


def extract_arm(robot_model: RobotModel) -> RobotModel:
    """The arm of a mobile manipulator as a fixed robot, whose frame 0 is the frame of the base on the floor.

    It is kinematic: without masses and force sensing, as those of the whole robot count.
    """
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
        dynamics=None,
        force_sensing=None,
        spheres=tuple(sphere for sphere in robot_model.spheres if sphere.link in names),
        self_pairs=SelfCollisionPairs(tuple(pair for pair in robot_model.self_pairs.kept if names >= set(pair)), ()),
    )


def extract_base(robot_model: RobotModel) -> RobotModel:
    """The base of a mobile robot, without an arm."""
    names = {link.name for link in robot_model.links if link.group == BASE_GROUP}
    return msgspec.structs.replace(
        robot_model,
        joints=robot_model.joints[:BASE_JOINTS],
        links=tuple(link for link in robot_model.links if link.name in names),
        spheres=tuple(sphere for sphere in robot_model.spheres if sphere.link in names),
        self_pairs=SelfCollisionPairs((), ()),
        home=robot_model.home[:BASE_NQ],
        dynamics=None,
        force_sensing=None,
    )
