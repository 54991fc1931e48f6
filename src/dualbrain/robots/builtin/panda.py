"""Definition of the Franka Emika Panda with its hand; `generate.py` adds collision spheres and link pairs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.assets.meshes import Mesh, collision_mesh
from dualbrain.robots.builtin import panda_dynamics
from dualbrain.robots.collision_model.fit_problem import LinkCoverSpec
from dualbrain.robots.model import Bound, Gripper, Joint, Link, Quaternion, Tool, Vector

SOURCE: str = "example-robot-data 6.0.0, panda_description (from franka_ros, franka_description)"
LICENCE: str = "Apache-2.0"
URDF = "panda.urdf"
FCI_ACCELERATION_SOURCE = "Franka FCI documentation, joint acceleration limits (libfranka kMaxJointAcceleration)"
FCI_JERK_SOURCE = "Franka FCI documentation, joint jerk limits (libfranka kMaxJointJerk)"

SQRT_HALF = 0.7071067811865476
QUARTER_TURNS: dict[str, Quaternion] = {
    "none": (1.0, 0.0, 0.0, 0.0),
    "minus": (SQRT_HALF, -SQRT_HALF, 0.0, 0.0),
    "plus": (SQRT_HALF, SQRT_HALF, 0.0, 0.0),
}
"""Quarter turns about local x."""

HAND_QUATERNION: Quaternion = (0.9238795325112867, 0.0, 0.0, -0.3826834323650898)
"""-45 degrees about z."""

# translation [m], quarter turn, lower [rad], upper [rad], velocity [rad/s], acceleration [rad/s²]
JOINTS: tuple[tuple[Vector, str, float, float, float, float], ...] = (
    ((0.0, 0.0, 0.333), "none", -2.8973, 2.8973, 2.175, 15.0),
    ((0.0, 0.0, 0.0), "minus", -1.7628, 1.7628, 2.175, 7.5),
    ((0.0, -0.316, 0.0), "plus", -2.8973, 2.8973, 2.175, 10.0),
    ((0.0825, 0.0, 0.0), "plus", -3.0718, -0.0698, 2.175, 12.5),
    ((-0.0825, 0.384, 0.0), "minus", -2.8973, 2.8973, 2.61, 15.0),
    ((0.0, 0.0, 0.0), "plus", -0.0175, 3.7525, 2.61, 20.0),
    ((0.088, 0.0, 0.0), "plus", -2.8973, 2.8973, 2.61, 20.0),
)

JERK_LIMITS = (7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0)
"""Joint jerk limits [rad/s³]."""

HOME = (0.0, -0.3, 0.0, -2.2, 0.0, 2.0, 0.785)
PERIOD = 0.001
TOOL_SPEED = Bound(0.4, "m/s", "site policy")
DYNAMICS, FORCE_SENSING = panda_dynamics.DYNAMICS, panda_dynamics.FORCE_SENSING
TOOL = Tool("hand", (0.0, 0.0, 0.1034))

FINGER_LENGTH = 0.0538
"""Lowest point of the finger below its origin [m] (collision mesh finger.stl)."""

GRIPPER = Gripper(
    opening=Bound(0.04, "m", f"{URDF}: panda_finger_joint1 limit upper"),
    force=Bound(60.0, "N", "site policy; the hand's data sheet allows 70 N continuous"),
    force_min=Bound(5.0, "N", "site policy"),
    pad_below_tool=round(0.0584 + FINGER_LENGTH - 0.1034, 4),
    finger_thickness=0.0264,
)

UP, DOWN = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
LEFT, RIGHT = (0.0, 1.0, 0.0), (0.0, -1.0, 0.0)
FRONT, BACK = (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)

WRIST_SPHERES = (((0.0, 0.037, 0.0), 0.0535), ((0.0, 0.083, 0.0), 0.058))
"""Two spheres on the wrist cylinder of link5 (radius 50 mm around the axis of joint 6), which link7 passes at 20 mm."""

LINK_COVERS: dict[str, tuple[LinkCoverSpec, ...]] = {
    "link0": (LinkCoverSpec(mesh="link0", n_spheres=3, weighted_faces=((DOWN, 0.2),)),),
    "link1": (LinkCoverSpec(mesh="link1", n_spheres=4),),
    "link2": (LinkCoverSpec(mesh="link2", n_spheres=4),),
    "link3": (LinkCoverSpec(mesh="link3", n_spheres=5),),
    "link4": (LinkCoverSpec(mesh="link4", n_spheres=5),),
    "link5": (LinkCoverSpec(mesh="link5", n_spheres=8, fixed_spheres=WRIST_SPHERES),),
    "link6": (LinkCoverSpec(mesh="link6", n_spheres=5),),
    "link7": (LinkCoverSpec(mesh="link7", n_spheres=8),),
    "hand": (LinkCoverSpec(mesh="hand", n_spheres=30, weighted_faces=((DOWN, 0.5),)),),
    "left_finger": (
        LinkCoverSpec(
            mesh="finger",
            n_spheres=16,
            weighted_faces=((DOWN, 0.4), (UP, 1.6), (LEFT, 0.7), (RIGHT, 1.5), (FRONT, 0.85), (BACK, 0.85)),
            weighted_slabs=((2, 0.034, 0.06, 2.5), (2, 0.015, 0.034, 1.5), (2, -0.01, 0.01, 0.8)),
        ),
    ),
}
"""Cover specification of each link, 104 spheres with both fingers; the right finger is the left one rotated by 180°
about z.

A finger points along +z and its pad faces -y: an excess there reduces the opening and the grasp, an excess into the
hand has no effect. The base is on the table, so an excess below link0 has little weight.
"""

ALLOWED_PAIRS = {
    ("left_finger", "right_finger"): "the gripper's own motion; opposite fingers close on each other by design",
}


def part_mesh(name: str) -> Mesh:
    """The collision mesh called `name`."""
    return collision_mesh("panda", name)


def mirror_centres(centres: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sphere centres of the right finger from those of the left finger."""
    return centres * np.array([-1.0, -1.0, 1.0])


def joints() -> tuple[Joint, ...]:
    """The seven joints with their limits and the provenance of each limit."""
    made: list[Joint] = []
    for i, (translation, turn, lower, upper, velocity, acceleration) in enumerate(JOINTS, start=1):
        entry = f"{URDF}: panda_joint{i} limit"
        made.append(
            Joint(
                name=f"panda_joint{i}",
                translation=translation,
                quaternion=QUARTER_TURNS[turn],
                lower=Bound(lower, "rad", f"{entry} lower"),
                upper=Bound(upper, "rad", f"{entry} upper"),
                velocity=Bound(velocity, "rad/s", f"{entry} velocity"),
                acceleration=Bound(acceleration, "rad/s^2", FCI_ACCELERATION_SOURCE),
                jerk=Bound(JERK_LIMITS[i - 1], "rad/s^3", FCI_JERK_SOURCE),
            )
        )
    return tuple(made)


def links() -> tuple[Link, ...]:
    """The base, seven arm links, the hand and two fingers."""
    arm = tuple(Link(name=f"link{i}", frame=i, group="arm") for i in range(8))
    finger_origin: Vector = (0.0, 0.0, 0.107 + 0.0584)
    return (
        *arm,
        Link(name="hand", frame=7, group="hand", translation=(0.0, 0.0, 0.107), quaternion=HAND_QUATERNION),
        Link(
            name="left_finger",
            frame=7,
            group="fingers",
            translation=finger_origin,
            quaternion=HAND_QUATERNION,
            slide=(0.0, 1.0, 0.0),
        ),
        Link(
            name="right_finger",
            frame=7,
            group="fingers",
            translation=finger_origin,
            quaternion=HAND_QUATERNION,
            slide=(0.0, -1.0, 0.0),
        ),
    )
