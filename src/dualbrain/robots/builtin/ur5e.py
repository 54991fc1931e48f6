"""Definition of the UR5e with a Robotiq 2F-85; `generate.py` adds collision spheres and link pairs.

The fingers of the 2F-85 are modelled as moving on straight lines. The real fingers move on parallelogram linkages and
reach 13 mm farther out when closed than when open, so the model has the length of the closed hand. The shape of the
knuckles, which swing, is enlarged so that it contains them while it moves with the finger.
"""

from __future__ import annotations

from dataclasses import replace
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.assets.meshes import Mesh, convex_hull_mesh, package_mesh, transform_mesh
from dualbrain.robots.builtin import ur5e_dynamics
from dualbrain.robots.collision_model.fit_problem import LinkCoverSpec
from dualbrain.robots.model import Bound, Gripper, Joint, Link, Quaternion, Tool, Vector

SOURCE: str = (
    "airo-models 0.0.12, ur5e.urdf and its convex collision meshes (from Universal_Robots_ROS2_Description); "
    "2F-85: outline drawn after Robotiq's data sheet"
)
LICENCE: str = "MIT (airo-models), BSD-3-Clause (Universal_Robots_ROS2_Description)"
URDF = "ur5e.urdf"
DATA_SHEET = "UR5e technical data sheet"
UNPUBLISHED_LIMIT_SOURCE = (
    "site policy; the maker publishes no limit; at rest it takes at most 86 % of any joint's torque in the model"
)

SQRT_HALF = sqrt(0.5)
HALF_TURN_Z: Quaternion = (0.0, 0.0, 0.0, 1.0)
IDENTITY: Quaternion = (1.0, 0.0, 0.0, 0.0)
PLUS_90_ABOUT_X: Quaternion = (SQRT_HALF, SQRT_HALF, 0.0, 0.0)
MINUS_90_ABOUT_X: Quaternion = (SQRT_HALF, -SQRT_HALF, 0.0, 0.0)
"""Quarter turns about local x."""

# name, translation [m], rotation, limit of ±q [rad]; x of the base frame points forward (REP 103), hence the half turn
JOINTS: tuple[tuple[str, Vector, Quaternion, float], ...] = (
    ("shoulder_pan_joint", (0.0, 0.0, 0.1625), HALF_TURN_Z, 6.2832),
    ("shoulder_lift_joint", (0.0, 0.0, 0.0), PLUS_90_ABOUT_X, 6.2832),
    ("elbow_joint", (-0.425, 0.0, 0.0), IDENTITY, 3.1416),
    ("wrist_1_joint", (-0.3922, 0.0, 0.1333), IDENTITY, 6.2832),
    ("wrist_2_joint", (0.0, -0.0997, 0.0), PLUS_90_ABOUT_X, 6.2832),
    ("wrist_3_joint", (0.0, 0.0996, 0.0), MINUS_90_ABOUT_X, 6.2832),
)
VELOCITY_LIMIT, ACCELERATION_LIMIT = 3.1416, 10.0

HOME = (-0.323, -1.7376, 1.393, -1.2262, -1.5708, -1.8938)
PERIOD = 0.002
TOOL_SPEED = Bound(0.4, "m/s", "site policy")
DYNAMICS, FORCE_SENSING = ur5e_dynamics.DYNAMICS, ur5e_dynamics.FORCE_SENSING

FINGER_TIP_REACH = 0.1735
"""Distance of the finger tips from the flange [m], hand closed."""
KNUCKLE_REACH = 0.1350
"""Largest distance of the knuckles from the flange [m], over the whole stroke."""
HOUSING_REACH = 0.1012
"""Largest distance of the gripper's base from the flange [m]."""
TOOL = Tool("hand", (0.0, 0.0, 0.1645))
GRIPPER = Gripper(
    opening=Bound(0.0425, "m", "half of the 85 mm stroke, Robotiq 2F-85 data sheet"),
    force=Bound(60.0, "N", "site policy; the 2F-85's data sheet allows 235 N"),
    force_min=Bound(20.0, "N", "Robotiq 2F-85 data sheet: grip force 20 to 235 N"),
    pad_below_tool=0.009,
    finger_thickness=0.033,
)

MESH_TO_LINK: Quaternion = (0.5, 0.5, -0.5, -0.5)
"""Rotation from the mesh frame (z along the link) to the chain frame (x against it): 90° about x, then -90° about z."""
MESH_POSES: dict[str, tuple[Vector, Quaternion]] = {
    "base": ((0.0, 0.0, 0.0), IDENTITY),
    "shoulder": ((0.0, 0.0, 0.0), HALF_TURN_Z),
    "upper_arm_link": ((0.0, 0.0, 0.138), MESH_TO_LINK),
    "forearm_link": ((0.0, 0.0, 0.007), MESH_TO_LINK),
    "wrist1": ((0.0, 0.0, -0.127), PLUS_90_ABOUT_X),
    "wrist2": ((0.0, 0.0, -0.0997), IDENTITY),
    "wrist3": ((0.0, 0.0, -0.0989), PLUS_90_ABOUT_X),
}
"""Poses of the collision meshes in their links, from the URDF: translation [m] and quaternion."""

UP, DOWN = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
INWARD = (0.0, -1.0, 0.0)

HAND_PART_CORNERS = {
    "mount": [(0.0425 * x, 0.0425 * y, z) for x, y in ((0.88, 0.37), (0.37, 0.99)) for z in (0.0, 0.075)],
    "housing": [
        (0.0195, 0.0742, 0.0555),
        (0.0195, 0.0742, HOUSING_REACH),
        (0.0375, 0.0425, 0.0555),
        (0.0375, 0.02, HOUSING_REACH),
    ],
}
"""A quarter of the corners of the two convex parts of the hand, flange frame [m]; the others by reflection in x and y.

The housing contains the base and the lower, fixed ends of the knuckles over the whole stroke.
"""
FINGER_PART_CORNERS = {
    "knuckle": [
        (0.0176, -0.0145, HOUSING_REACH - 0.0025),
        (0.0176, 0.0022, 0.121),
        (0.0176, 0.0040, KNUCKLE_REACH),
        (0.0176, 0.034, KNUCKLE_REACH),
        (0.0176, 0.0520, 0.117),
        (0.0176, 0.0520, HOUSING_REACH - 0.0025),
        (0.0076, 0.0022, 0.138),
        (0.0076, 0.0170, 0.138),
    ],
    "tip": [
        (0.0110, 0.0, 0.1345),
        (0.0110, 0.0, FINGER_TIP_REACH),
        (0.0110, 0.0090, FINGER_TIP_REACH),
        (0.0110, 0.0090, 0.1345),
        (0.0076, 0.0160, 0.1345),
        (0.0076, 0.0145, 0.168),
    ],
}
"""Half of the corners of the moving parts on the left side, hand closed, flange frame [m]; others by reflection in x.

The upper ends of the real knuckles swing; they stay inside the part `knuckle`, which moves with the finger.
"""

LINK_COVERS: dict[str, tuple[LinkCoverSpec, ...]] = {
    "link0": (LinkCoverSpec(mesh="base", n_spheres=3, weighted_faces=((DOWN, 0.2),)),),
    "link1": (LinkCoverSpec(mesh="shoulder", n_spheres=4),),
    "link2": (
        LinkCoverSpec(mesh="upper_arm_link_part_0", n_spheres=4),
        LinkCoverSpec(mesh="upper_arm_link_part_1", n_spheres=5),
        LinkCoverSpec(mesh="upper_arm_link_part_2", n_spheres=5),
    ),
    "link3": (
        LinkCoverSpec(mesh="forearm_link_part_0", n_spheres=3),
        LinkCoverSpec(mesh="forearm_link_part_1", n_spheres=5),
        LinkCoverSpec(mesh="forearm_link_part_2", n_spheres=3),
    ),
    "link4": (LinkCoverSpec(mesh="wrist1", n_spheres=5),),
    "link5": (LinkCoverSpec(mesh="wrist2", n_spheres=5),),
    "link6": (LinkCoverSpec(mesh="wrist3", n_spheres=3),),
    "hand": (
        LinkCoverSpec(mesh="mount", n_spheres=8, weighted_faces=((DOWN, 0.5), (UP, 0.5))),
        LinkCoverSpec(mesh="housing", n_spheres=15, weighted_faces=((DOWN, 0.5),)),
    ),
    "left_knuckle": (
        LinkCoverSpec(mesh="knuckle", n_spheres=8, weighted_faces=((UP, 1.3), (INWARD, 1.5), (DOWN, 0.4))),
    ),
    "left_finger": (LinkCoverSpec(mesh="tip", n_spheres=12, weighted_faces=((UP, 1.6), (INWARD, 1.5), (DOWN, 0.5))),),
}
"""Cover specification of each link, 108 spheres; the right side of the hand is the left one rotated by 180° about z."""

LEAN_SPHERES = {
    "shoulder": 3,
    "upper_arm_link_part_0": 2,
    "upper_arm_link_part_1": 3,
    "upper_arm_link_part_2": 2,
    "forearm_link_part_0": 2,
    "forearm_link_part_1": 3,
    "forearm_link_part_2": 2,
    "wrist1": 3,
    "wrist2": 3,
    "wrist3": 2,
    "mount": 3,
    "housing": 6,
    "knuckle": 4,
    "tip": 6,
}
"""Numbers of spheres of the robot `ur5e_lean`, by mesh: 57 in all, for filters on a microcontroller."""
LEAN_LINK_COVERS = {
    link: tuple(replace(part, n_spheres=LEAN_SPHERES.get(part.mesh, part.n_spheres)) for part in parts)
    for link, parts in LINK_COVERS.items()
}

ALLOWED_PAIRS = {
    (f"left_{one}", f"right_{other}"): "the gripper's own motion; opposite fingers close on each other by design"
    for one in ("knuckle", "finger")
    for other in ("knuckle", "finger")
}


def part_mesh(name: str) -> Mesh:
    """The mesh of one convex part of a link, in the link frame."""
    if name in HAND_PART_CORNERS:
        return convex_hull_mesh(
            np.array([(sx * x, sy * y, z) for x, y, z in HAND_PART_CORNERS[name] for sx in (-1, 1) for sy in (-1, 1)])
        )
    if name in FINGER_PART_CORNERS:
        return convex_hull_mesh(np.array([(sx * x, y, z) for x, y, z in FINGER_PART_CORNERS[name] for sx in (-1, 1)]))
    translation, quaternion = MESH_POSES[name.partition("_part_")[0]]
    return transform_mesh(
        package_mesh("airo-models", f"airo_models/arms/ur5e/collision/{name}.obj"), translation, quaternion
    )


def mirror_centres(centres: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sphere centres of a part on the right side from those of the part on the left side."""
    return centres * np.array([-1.0, -1.0, 1.0])


def joints() -> tuple[Joint, ...]:
    """The six joints with their limits and the provenance of each limit."""
    return tuple(
        Joint(
            name=name,
            translation=translation,
            quaternion=quaternion,
            lower=Bound(-reach, "rad", f"{URDF}: {name} limit lower"),
            upper=Bound(reach, "rad", f"{URDF}: {name} limit upper"),
            velocity=Bound(VELOCITY_LIMIT, "rad/s", f"{URDF}: {name} limit velocity; {DATA_SHEET}: 180 degrees/s"),
            acceleration=Bound(ACCELERATION_LIMIT, "rad/s^2", UNPUBLISHED_LIMIT_SOURCE),
        )
        for name, translation, quaternion, reach in JOINTS
    )


def links() -> tuple[Link, ...]:
    """The base, six arm links, the hand, two knuckles and two fingers; all frames of the hand are the flange frame."""
    arm = tuple(Link(name=f"link{i}", frame=i, group="arm") for i in range(7))
    return (
        *arm,
        Link(name="hand", frame=6, group="hand"),
        Link(name="left_knuckle", frame=6, group="hand", slide=(0.0, 1.0, 0.0)),
        Link(name="right_knuckle", frame=6, group="hand", slide=(0.0, -1.0, 0.0)),
        Link(name="left_finger", frame=6, group="fingers", slide=(0.0, 1.0, 0.0)),
        Link(name="right_finger", frame=6, group="fingers", slide=(0.0, -1.0, 0.0)),
    )
