"""What the body is: kinematic chain, limits with the provenance of each bound, collision spheres, tracking model."""

from __future__ import annotations

from typing import Literal

import msgspec

from dualbrain.errors import UnknownNameError

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class Bound(msgspec.Struct, frozen=True):
    """One limit: its value, its SI unit and where it comes from (file and entry, data sheet, site policy)."""

    value: float
    unit: str
    provenance: str


class Joint(msgspec.Struct, frozen=True, kw_only=True):
    """A joint: fixed transform from the parent frame, then a turn about local z, or a slide along it.

    Of a prismatic joint position, velocity and acceleration are in m, m/s and m/s².
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
    """A rigid part: rides on chain frame `frame` (0 = base, i = after joint i) at a fixed transform.

    `group` is the name that permits use ("arm", "hand", "fingers"). A finger slides along `slide` (unit vector in its
    link frame) by the finger opening.
    """

    name: str
    frame: int
    group: str
    translation: Vector = (0.0, 0.0, 0.0)
    quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)
    slide: Vector = (0.0, 0.0, 0.0)


class CollisionSphere(msgspec.Struct, frozen=True):
    """A ball that covers part of `link`: `centre` [m] in the link frame at zero opening, `radius` [m]."""

    link: str
    centre: Vector
    radius: float


class Tool(msgspec.Struct, frozen=True):
    """The tool frame: on link `link`, z along the approach, y along the finger axis."""

    link: str
    translation: Vector
    quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)


class Gripper(msgspec.Struct, frozen=True, kw_only=True):
    """A parallel gripper: opening per finger [m], grip force [N], pad length beyond the tool frame [m]."""

    opening: Bound
    force: Bound
    force_min: Bound
    pad_below_tool: float
    finger_thickness: float


class TrackingErrorModel(msgspec.Struct, frozen=True, kw_only=True):
    """How the joints follow a velocity command u: y = q + lag v obeys ẏ = u + r with |∫ exp(−α (t − s)) r ds| ≤ e.

    `lag` [s]; `position_error` e of each joint [rad, of a prismatic one m]; `rate` α [1/s] at which e was identified;
    `drive` names what was identified. Made by `dualbrain robot identify`, or from the maker's figures.
    """

    lag: float
    position_error: float
    rate: float
    provenance: str
    drive: str = ""

    def row_margin(self, alpha: float) -> float:
        """What a barrier row of gain `alpha` [1/s] must keep for e [rad/s]: α e, at any other rate a bound of it.

        By parts, the leaky integral at rate a is at most e α/a where a < α, and e (2 − α/a) where a > α.
        """
        return self.position_error * (self.rate + 2.0 * max(0.0, alpha - self.rate))


class SelfCollisionPairs(msgspec.Struct, frozen=True):
    """Pairs of links whose spheres are kept apart, and the reason for every pair that is left out."""

    kept: tuple[tuple[str, str], ...]
    allowed: tuple[tuple[str, str, str], ...]


class RobotModel(msgspec.Struct, frozen=True, kw_only=True):
    """Everything the filter and the skills know of one robot; pure data, read from `data/<name>.json`.

    `gain` [1/s] bounds the filter's α where it must be below what the acceleration limits alone can follow.
    `base_lag` [s] is by how much later than `tracking.lag` a base follows its command; where it is given, the filter
    takes the base along its arcs, and else straight on for the moment.
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

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joints)

    @property
    def is_mobile(self) -> bool:
        """Whether the body drives: its configuration begins with (x, y, θ), its control with (v, ω)."""
        return self.base == "differential"

    @property
    def is_mobile_manipulator(self) -> bool:
        """Whether the body drives and has an arm as well: a mobile manipulator."""
        return self.is_mobile and self.n > 2

    @property
    def nq(self) -> int:
        """Length of a configuration q: one more than the control's where the body drives."""
        return self.n + self.is_mobile

    @property
    def alpha(self) -> float:
        """Largest class-K gain that braking can follow: min_i a_i / v_i, and no more than `gain` [1/s]."""
        followed = min(joint.acceleration.value / joint.velocity.value for joint in self.joints)
        return min(followed, self.gain.value) if self.gain else followed

    def with_drive(self, drive: str) -> RobotModel:
        """This body with the tracking model of another of its drives; raises `UnknownName` with the identified ones."""
        known = {tracking.drive: tracking for tracking in (self.tracking, *self.other_drives)}
        if drive not in known:
            raise UnknownNameError("identified drive", drive, tuple(known), owner=f"body {self.name}")
        others = tuple(tracking for name, tracking in known.items() if name != drive)
        return msgspec.structs.replace(self, tracking=known[drive], other_drives=others)

    def with_tracking(self, tracking: TrackingErrorModel) -> RobotModel:
        """This body with the tracking model of one of its drives renewed, or added beside the others."""
        if tracking.drive == self.tracking.drive:
            return msgspec.structs.replace(self, tracking=tracking)
        others = {other.drive: other for other in (*self.other_drives, tracking)}
        return msgspec.structs.replace(self, other_drives=tuple(others.values()))
