"""Robot model: kinematic chain, limits with the provenance of each bound, collision spheres, tracking-error model."""

from __future__ import annotations

from typing import Literal

import msgspec

from dualbrain.errors import UnknownNameError

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class Bound(msgspec.Struct, frozen=True):
    """One limit: value, SI unit and provenance (file and entry, data sheet, or site policy)."""

    value: float
    unit: str
    provenance: str


class Joint(msgspec.Struct, frozen=True, kw_only=True):
    """A joint: fixed transform from the parent frame, then a rotation about local z, or a translation along it.

    Bounds are in rad, rad/s, rad/s² and rad/s³; of a prismatic joint in m, m/s, m/s² and m/s³.
    """

    name: str
    translation: Vector
    quaternion: Quaternion
    lower: Bound
    upper: Bound
    velocity: Bound
    acceleration: Bound
    jerk: Bound | None = None
    kind: Literal["revolute", "prismatic"] = "revolute"


class Link(msgspec.Struct, frozen=True, kw_only=True):
    """A rigid link, attached to chain frame `frame` (0 = base, i = after joint i) at a fixed transform.

    `group` is the name that contact permits use ("arm", "hand", "fingers"). A finger moves along `slide` (unit vector
    in its link frame) by the finger opening.
    """

    name: str
    frame: int
    group: str
    translation: Vector = (0.0, 0.0, 0.0)
    quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)
    slide: Vector = (0.0, 0.0, 0.0)


class CollisionSphere(msgspec.Struct, frozen=True):
    """A sphere that covers part of `link`: `centre` [m] in the link frame at zero opening, `radius` [m]."""

    link: str
    centre: Vector
    radius: float


class Tool(msgspec.Struct, frozen=True):
    """The tool frame, fixed to `link`: z along the approach direction, y along the finger axis."""

    link: str
    translation: Vector
    quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)


class Gripper(msgspec.Struct, frozen=True, kw_only=True):
    """A parallel gripper: opening per finger [m], grip force [N], length of the pads beyond the tool frame [m]."""

    opening: Bound
    force: Bound
    force_min: Bound
    pad_below_tool: float
    finger_thickness: float


class TrackingErrorModel(msgspec.Struct, frozen=True, kw_only=True):
    """How the joints track a velocity command u: y = q + lag v obeys ẏ = u + r with |∫ exp(−α (t − s)) r ds| ≤ e.

    `lag` [s]; `position_error` e [rad, of a prismatic joint m], one number for all joints or one for each; `rate` α
    [1/s] at which e was identified; `drive` names the identified drive. Measured by `dualbrain robot identify`, or
    taken from the manufacturer's data.
    """

    lag: float
    position_error: float | tuple[float, ...]
    rate: float
    provenance: str
    drive: str = ""

    def position_errors(self, n: int) -> tuple[float, ...]:
        """The error e of each of `n` joints [rad, of a prismatic joint m]."""
        return self.position_error if isinstance(self.position_error, tuple) else (self.position_error,) * n

    def row_margins(self, alpha: float, n: int) -> tuple[float, ...]:
        """Margin [rad/s] of each of `n` joints, of a barrier row of gain `alpha` [1/s] against the tracking error.

        The margin is α e at the identified rate, and an upper bound of it at any other rate a: integration by parts
        bounds the leaky integral by e α/a where a < α, and by e (2 − α/a) where a > α.
        """
        return tuple(error * (self.rate + 2.0 * max(0.0, alpha - self.rate)) for error in self.position_errors(n))


class RigidBody(msgspec.Struct, frozen=True, kw_only=True):
    """A rigid body on chain frame `frame`: `mass` [kg], `centre` of mass [m], inertia about it [kg m²].

    `inertia` is (xx, yy, zz, xy, xz, yz) along the axes of the frame.
    """

    frame: int
    mass: float
    centre: Vector
    inertia: tuple[float, float, float, float, float, float]


class DynamicModel(msgspec.Struct, frozen=True, kw_only=True):
    """Masses of the robot, without those of a mobile base, and of each joint the inertia of its rotor and its damping.

    `rotor_inertia` [kg m²] is reflected to the joint, `damping` in Nm s/rad; the entries of a base's joints are 0.
    `payload` [kg] is the largest mass in the hand.
    """

    bodies: tuple[RigidBody, ...]
    rotor_inertia: tuple[float, ...]
    damping: tuple[float, ...]
    payload: Bound
    provenance: str


class ForceSensing(msgspec.Struct, frozen=True, kw_only=True):
    """The sensor from which contact forces are estimated: the torques of the motors, or a wrench at the wrist.

    `noise` is the standard deviation of one reading and `accuracy` the bound of its constant error, one entry per
    channel: for "motor_torques" the joints [Nm], 0 for those of a mobile base; for "wrist_wrench" the force along x, y
    and z [N] and the torque about them [Nm] at the origin of the last chain frame, in its axes.
    """

    kind: Literal["motor_torques", "wrist_wrench"]
    noise: tuple[float, ...]
    accuracy: tuple[float, ...]
    provenance: str


class SelfCollisionPairs(msgspec.Struct, frozen=True):
    """Pairs of links whose spheres the filter keeps apart, and every excluded pair with the reason."""

    kept: tuple[tuple[str, str], ...]
    allowed: tuple[tuple[str, str, str], ...]


class RobotModel(msgspec.Struct, frozen=True, kw_only=True):
    """The complete data of one robot for the filter and the skills, stored in `data/<name>.json`.

    `gain` [1/s] is an upper bound of the filter's α where α must be below the value that the acceleration limits allow.
    `base_lag` [s] is the lag of a mobile base beyond `tracking.lag`. If it is given, the filter predicts the base along
    an arc; otherwise it predicts a straight motion. Without `force_sensing` contact forces are not supervised, and
    without `dynamics` they cannot be: the estimate subtracts the torque of the robot's own motion.
    """

    name: str
    source: str
    licence: str
    joints: tuple[Joint, ...]
    links: tuple[Link, ...]
    spheres: tuple[CollisionSphere, ...]
    self_pairs: SelfCollisionPairs
    tool: Tool
    gripper: Gripper
    home: tuple[float, ...]
    tracking: TrackingErrorModel
    period: float
    tool_speed: Bound
    base: Literal["fixed", "differential"] = "fixed"
    other_drives: tuple[TrackingErrorModel, ...] = ()
    gain: Bound | None = None
    base_lag: float | None = None
    dynamics: DynamicModel | None = None
    force_sensing: ForceSensing | None = None

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joints)

    @property
    def is_mobile(self) -> bool:
        """Whether the robot has a mobile base: its configuration begins with (x, y, θ), its control with (v, ω)."""
        return self.base == "differential"

    @property
    def is_mobile_manipulator(self) -> bool:
        """Whether the robot has a mobile base and an arm."""
        return self.is_mobile and self.n > 2

    @property
    def nq(self) -> int:
        """Length of a configuration q: `n`, and one more for a mobile base."""
        return self.n + self.is_mobile

    @property
    def alpha(self) -> float:
        """Largest class-K gain [1/s] that braking can follow: min_i a_i / v_i, and at most `gain`."""
        achievable = min(joint.acceleration.value / joint.velocity.value for joint in self.joints)
        return min(achievable, self.gain.value) if self.gain else achievable

    def with_drive(self, drive: str) -> RobotModel:
        """This robot with the tracking-error model of the identified `drive`; raises `UnknownNameError`."""
        known = {tracking.drive: tracking for tracking in (self.tracking, *self.other_drives)}
        if drive not in known:
            raise UnknownNameError("identified drive", drive, tuple(known), owner=f"robot {self.name}")
        others = tuple(tracking for name, tracking in known.items() if name != drive)
        return msgspec.structs.replace(self, tracking=known[drive], other_drives=others)

    def with_tracking(self, tracking: TrackingErrorModel) -> RobotModel:
        """This robot with `tracking` in place of the model of the same drive, or added to the models of the others."""
        if tracking.drive == self.tracking.drive:
            return msgspec.structs.replace(self, tracking=tracking)
        others = {other.drive: other for other in (*self.other_drives, tracking)}
        return msgspec.structs.replace(self, other_drives=tuple(others.values()))
