"""Definition of the ViperX 300 S of gym-aloha, an arm of six position servos; `generate.py` adds spheres and pairs.

The shapes are the convex hulls of the meshes, because MuJoCo collides with these. The fingers slide on servos that are
no joints of the model: their commands pass the filter unchanged, and the link `fingers` is the envelope of both over
their whole range.

The limits of speed and acceleration are site policy. The MJCF states none, and the error of its servos, and with it the
margin of every barrier, grows with the speed: from 22 mrad at 0.5 rad/s to 59 mrad at 1 rad/s for the waist.
"""

from __future__ import annotations

from collections.abc import Callable
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.assets.meshes import Mesh, convex_hull_mesh, package_mesh, transform_mesh
from dualbrain.robots.builtin.fitted_parts import (
    N_CONFIGURATIONS,
    describe_fit,
    fitted_pairs,
    fitted_spheres,
    no_gripper,
)
from dualbrain.robots.collision_model.sphere_budget import FULL, FitEffort, fit_links
from dualbrain.robots.model import (
    Bound,
    Joint,
    Link,
    Quaternion,
    RobotModel,
    Tool,
    TrackingErrorModel,
    Vector,
)

Array = NDArray[np.float64]

PACKAGE = "gym-aloha"
SOURCE: str = (
    "gym-aloha 0.1.5, vx300s_left.xml and its meshes (from ALOHA, https://github.com/tonyzhaozh/aloha, and the ViperX "
    "300 S of Trossen Robotics)"
)
LICENCE: str = "Apache-2.0"
MJCF = "vx300s_left.xml"
MESH_SCALE = 1e-3
"""Metres per unit of the meshes."""
SPEED_SOURCE = f"site policy: {MJCF} states no limit; the error of the servos grows with the speed"
ACCELERATION_SOURCE = f"site policy: {MJCF} states no limit; the servos follow it within the tracking error"
VELOCITY_LIMIT, ACCELERATION_LIMIT = 0.5, 6.0
PERIOD = 0.01
"""Two periods of the filter in one step of gym-aloha [s]."""
TOOL_SPEED = Bound(0.4, "m/s", "site policy")
HOME = (0.0, -0.96, 1.16, 0.0, -0.3, 0.0)
"""The start posture of gym-aloha."""

SQRT_HALF = sqrt(0.5)
IDENTITY: Quaternion = (1.0, 0.0, 0.0, 0.0)
TO_Y: Quaternion = (SQRT_HALF, SQRT_HALF, 0.0, 0.0)
TO_X: Quaternion = (SQRT_HALF, 0.0, -SQRT_HALF, 0.0)
"""Rotation of a body of the MJCF in the frame of its joint, whose z axis is the axis of the joint."""
JOINTS: tuple[tuple[str, Vector, Quaternion, float, float], ...] = (
    ("waist", (0.0, 0.0, 0.079), IDENTITY, -3.14158, 3.14158),
    ("shoulder", (0.0, 0.0, 0.04805), (SQRT_HALF, -SQRT_HALF, 0.0, 0.0), -1.85005, 1.25664),
    ("elbow", (0.05955, -0.3, 0.0), IDENTITY, -1.76278, 1.6057),
    ("forearm_roll", (0.2, 0.0, 0.0), (0.5, 0.5, 0.5, 0.5), -3.14158, 3.14158),
    ("wrist_angle", (0.0, 0.0, 0.1), (0.5, -0.5, -0.5, -0.5), -1.8675, 2.23402),
    ("wrist_rotate", (0.069744, 0.0, 0.0), (0.5, 0.5, 0.5, 0.5), -3.14158, 3.14158),
)
"""Name, translation [m], rotation, lower and upper limit [rad] of each joint, from the MJCF."""

QUARTER_TURN: Quaternion = (SQRT_HALF, 0.0, 0.0, SQRT_HALF)
LINK_PARTS: dict[str, tuple[Quaternion, tuple[tuple[str, Vector, Quaternion], ...]]] = {
    "base": (IDENTITY, (("1_base", (0.0, 0.0, 0.0), QUARTER_TURN),)),
    "shoulder": (IDENTITY, (("2_shoulder", (0.0, 0.0, -0.003), QUARTER_TURN),)),
    "upper_arm": (TO_Y, (("3_upper_arm", (0.0, 0.0, 0.0), QUARTER_TURN),)),
    "upper_forearm": (TO_Y, (("4_upper_forearm", (0.0, 0.0, 0.0), IDENTITY),)),
    "lower_forearm": (TO_X, (("5_lower_forearm", (0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0)),)),
    "wrist": (TO_Y, (("6_wrist", (0.0, 0.0, 0.0), QUARTER_TURN),)),
    "gripper": (
        TO_X,
        (
            ("7_gripper", (-0.02, 0.0, 0.0), QUARTER_TURN),
            ("9_gripper_bar", (-0.020175, 0.0, 0.0), QUARTER_TURN),
            ("8_gripper_prop", (-0.02, 0.0, 0.0), QUARTER_TURN),
        ),
    ),
}
"""Of each link the rotation of its body (`TO_X`) and its meshes with their poses in that; `fingers` are made by
`finger_envelopes`."""

FINGER_ORIGIN: Vector = (0.0687, 0.0, 0.0)
FINGER_RANGE = (0.021, 0.057)
"""Place of the fingers in the body of the gripper, and range of each along y, right ones along −y [m]."""
FINGERS: tuple[tuple[str, Vector, float], ...] = (
    ("10_custom_finger_left", (0.005, -0.052, 0.0), 1.0),
    ("10_custom_finger_right", (0.005, 0.052, 0.0), -1.0),
)
"""Mesh of each finger, its place in its body [m], and the direction in which it opens along y."""
FINGER_ANGLES = (3.14, 1.57)
"""Rotation of both meshes in their bodies about x, and then about the turned y [rad]; the MJCF rounds π."""

WEIGHTS = {
    "base": 0.35,
    "shoulder": 0.8,
    "upper_arm": 1.0,
    "upper_forearm": 1.0,
    "lower_forearm": 1.0,
    "wrist": 1.0,
    "gripper": 1.0,
    "fingers": 1.0,
}
"""Weight of the excess by link: an excess on the base and on the shoulder hardly matters."""
SPHERE_BUDGET = 64
"""Few spheres, because every pair of spheres of two arms that are near each other is a row of both filters."""
SEED = 0

TOOL = Tool("gripper", (0.0, 0.0, 0.14), IDENTITY)
GRIPPER = no_gripper("the fingers are driven by servos that are no part of the model, so that no skill grasps with it")


def make_model(
    tracking: TrackingErrorModel, report_progress: Callable[[str], None], effort: FitEffort = FULL
) -> RobotModel:
    """The model with spheres fitted to the hulls of the package's meshes and the identified tracking-error model."""
    shapes = link_shapes()
    fits = fit_links(shapes, WEIGHTS, SPHERE_BUDGET, effort, SEED)
    for name, fit in fits.items():
        report_progress(describe_fit(name, fit))
    report_progress(f"self pairs: {N_CONFIGURATIONS} random configurations")
    return RobotModel(
        name="vx300s",
        source=SOURCE,
        licence=LICENCE,
        joints=joints(),
        links=links(),
        spheres=fitted_spheres(fits),
        self_pairs=fitted_pairs(joints(), links(), fits, shapes, SEED),
        tool=TOOL,
        gripper=GRIPPER,
        home=HOME,
        tracking=tracking,
        period=PERIOD,
        tool_speed=TOOL_SPEED,
    )


def joints() -> tuple[Joint, ...]:
    """The six joints with their limits and the provenance of each limit."""
    return tuple(
        Joint(
            name=name,
            translation=translation,
            quaternion=quaternion,
            lower=Bound(lower, "rad", f"{MJCF}: {name} range"),
            upper=Bound(upper, "rad", f"{MJCF}: {name} range"),
            velocity=Bound(VELOCITY_LIMIT, "rad/s", SPEED_SOURCE),
            acceleration=Bound(ACCELERATION_LIMIT, "rad/s^2", ACCELERATION_SOURCE),
        )
        for name, translation, quaternion, lower, upper in JOINTS
    )


def links() -> tuple[Link, ...]:
    """The base, five arm links, the gripper without its fingers, and the envelope of the fingers."""
    groups = ("base", *("arm",) * 5, "hand")
    arm = tuple(
        Link(name=name, frame=frame, group=group)
        for frame, (name, group) in enumerate(zip(LINK_PARTS, groups, strict=True))
    )
    return (*arm, Link(name="fingers", frame=len(JOINTS), group="fingers"))


def link_shapes() -> dict[str, list[Mesh]]:
    """The convex hulls of the meshes of each link in its frame.

    Raises:
        MissingDependencyError: the package with the meshes is not installed.
    """
    shapes = {
        link: [
            transform_mesh(transform_mesh(read_hull(name), translation, quaternion), (0.0, 0.0, 0.0), turn)
            for name, translation, quaternion in parts
        ]
        for link, (turn, parts) in LINK_PARTS.items()
    }
    return shapes | {"fingers": finger_envelopes()}


def read_hull(name: str) -> Mesh:
    """The convex hull of one mesh in its own frame."""
    return convex_hull_mesh(MESH_SCALE * package_mesh(PACKAGE, f"gym_aloha/assets/vx300s_{name}.stl").vertices)


def finger_envelopes() -> list[Mesh]:
    """Of each finger the convex hull of all its positions, in the frame of the last joint."""
    return [
        transform_mesh(convex_hull_mesh(np.vstack([finger_at(index, s) for s in FINGER_RANGE])), (0.0, 0.0, 0.0), TO_X)
        for index in range(len(FINGERS))
    ]


def finger_at(index: int, opening: float) -> Array:
    """Corners (p, 3) of the hull of finger `index` at `opening` [m], in the body of the gripper."""
    name, place, direction = FINGERS[index]
    (cx, sx), (cy, sy) = ((np.cos(angle), np.sin(angle)) for angle in FINGER_ANGLES)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    about_y = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    shift = np.add(FINGER_ORIGIN, place) + np.array([0.0, direction * opening, 0.0])
    return read_hull(name).vertices @ (about_x @ about_y).T + shift
