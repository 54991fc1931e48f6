"""Inverse dynamics of an arm: the joint torques of its own motion and weight.

Recursive Newton-Euler equations in the axes of each frame (Craig, Introduction to Robotics, 6.5; R is the rotation from
frame i to frame i − 1, p the origin of frame i in frame i − 1, z its axis; m, c and I are mass, centre and the inertia
about the centre of the bodies on frame i):

    ω_i = Rᵀω_{i-1} + z q̇_i                     α_i = Rᵀα_{i-1} + z q̈_i + Rᵀω_{i-1} × z q̇_i
    a_i = Rᵀ(a_{i-1} + α_{i-1} × p + ω_{i-1} × (ω_{i-1} × p)),     a_0 = acceleration of the base − gravity
    f_i = m (a_i + α_i × c + ω_i × (ω_i × c)),   n_i = I α_i + ω_i × I ω_i
    F_i = f_i + R F_{i+1},                       N_i = n_i + c × f_i + R N_{i+1} + p_{i+1} × R F_{i+1}
    τ_i = z·N_i + rotor_i q̈_i + damping_i q̇_i

A prismatic joint adds z q̈_i + 2 ω_i × z q̇_i to a_i instead of its parts in ω and α, and its force is z·F_i. The
fingers count as closed and at rest in the hand. The loops use Python's floats: with 3-vectors they take a quarter of
the time of numpy.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.errors import ConfigurationError
from dualbrain.robots.model import RigidBody, RobotModel

Array = NDArray[np.float64]
Three = tuple[float, float, float]
Rotation = tuple[Three, Three, Three]
"""Columns of a rotation matrix."""

GRAVITY = 9.81
"""Acceleration of free fall [m/s²]; the base is upright."""
BASE_JOINTS = 2
"""Number of controls (v, ω) of a mobile base."""
ZERO: Three = (0.0, 0.0, 0.0)
NO_INERTIA = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameMass:
    """Mass [kg], centre [m] and inertia about it (xx, yy, zz, xy, xz, yz) [kg m²] of all bodies on one frame."""

    mass: float
    centre: Three
    inertia: tuple[float, float, float, float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmTorque:
    """Joint torques of an arm with n joints [Nm; of a prismatic joint N].

    `own` (n,) moves the arm, `per_load` (n,) moves 1 kg at the origin of the tool frame. `wrist` (6,) and
    `wrist_per_load` (6,) are force [N] and torque [Nm] on the last frame, in its axes and about its origin.
    """

    own: Array
    per_load: Array
    wrist: Array
    wrist_per_load: Array


class ArmDynamics:
    """The dynamic model of the arm of `robot_model`, which a mobile base may move."""

    def __init__(self, robot_model: RobotModel) -> None:
        """Read chain and masses; raises `ConfigurationError` without a dynamic model."""
        dynamics = robot_model.dynamics
        if dynamics is None:
            raise ConfigurationError.stating(
                f"Robot {robot_model.name!r} has no dynamic model.",
                fix="Add `dynamics` (masses, centres, inertias) to its model, or remove `force_sensing`.",
            )
        self.first_joint = first = BASE_JOINTS if robot_model.is_mobile else 0
        joints = robot_model.joints[first:]
        self.n = len(joints)
        self._turns = [_columns(quaternion_to_matrix(joint.quaternion)) for joint in joints]
        self._steps = [joint.translation for joint in joints]
        self._slides = [joint.kind == "prismatic" for joint in joints]
        self._masses = [
            combine_bodies([body for body in dynamics.bodies if body.frame == first + 1 + index])
            for index in range(self.n)
        ]
        self._rotors, self._damping = dynamics.rotor_inertia[first:], dynamics.damping[first:]
        self._load = FrameMass(mass=1.0, centre=_tool_in_last_frame(robot_model), inertia=NO_INERTIA)

    def torque(self, q: Array, v: Array, acceleration: Array, *, loaded: bool = True) -> ArmTorque:
        """Torques at the state `q`, `v` of a `RobotState` and `acceleration`, of the length of `v` [rad/s², m/s²].

        Without `loaded` those per kilogram of load are 0, which saves a quarter of the time.
        """
        first = self.first_joint
        angles, speeds, rates = q.tolist()[len(q) - self.n :], v.tolist()[first:], acceleration.tolist()[first:]
        chain = [self._joint_frame(index, angle) for index, angle in enumerate(angles)]
        spin, turn, linear = _base_motion(v.tolist(), acceleration.tolist()) if first else _RESTING_BASE
        forces: list[Three] = []
        moments: list[Three] = []
        for index, (rotation, step) in enumerate(chain):
            linear = _to_child(rotation, _point_acceleration(spin, turn, linear, step))
            spin, turn, linear = self._add_joint(
                index, _to_child(rotation, spin), _to_child(rotation, turn), linear, speeds[index], rates[index]
            )
            force, moment = _body_wrench(self._masses[index], spin, turn, linear)
            forces.append(force)
            moments.append(moment)
        load_force, load_moment = _body_wrench(self._load, spin, turn, linear) if loaded else (ZERO, ZERO)
        wrist, wrist_per_load = (forces[-1], moments[-1]), (load_force, load_moment)
        own, nothing = self._collect(chain, forces, moments), [ZERO] * (self.n - 1)
        per_load = self._collect(chain, [*nothing, load_force], [*nothing, load_moment]) if loaded else [0.0] * self.n
        for index in range(self.n):
            own[index] += self._rotors[index] * rates[index] + self._damping[index] * speeds[index]
        return ArmTorque(
            own=np.array(own),
            per_load=np.array(per_load),
            wrist=np.array(wrist).ravel(),
            wrist_per_load=np.array(wrist_per_load).ravel(),
        )

    def _joint_frame(self, index: int, angle: float) -> tuple[Rotation, Three]:
        """Rotation and origin of frame `index` in the frame before it, with the joint at `angle` [rad or m]."""
        (x, y, z), step = self._turns[index], self._steps[index]
        if self._slides[index]:
            return (x, y, z), _add(step, _scale(angle, z))
        c, s = cos(angle), sin(angle)
        return (
            (c * x[0] + s * y[0], c * x[1] + s * y[1], c * x[2] + s * y[2]),
            (c * y[0] - s * x[0], c * y[1] - s * x[1], c * y[2] - s * x[2]),
            z,
        ), step

    def _add_joint(
        self, index: int, spin: Three, turn: Three, linear: Three, speed: float, rate: float
    ) -> tuple[Three, Three, Three]:
        """ω, α and a of a frame with the motion of its joint, from those of the frame before it in its axes."""
        (wx, wy, wz), (ax, ay, az) = spin, turn
        if self._slides[index]:
            x, y, z = linear
            return spin, turn, (x + 2.0 * wy * speed, y - 2.0 * wx * speed, z + rate)
        return (wx, wy, wz + speed), (ax + wy * speed, ay - wx * speed, az + rate), linear

    def _collect(self, chain: list[tuple[Rotation, Three]], forces: list[Three], moments: list[Three]) -> list[float]:
        """Torque of each joint from the force and moment on each frame."""
        torques = [0.0] * self.n
        force, moment = ZERO, ZERO
        for index in range(self.n - 1, -1, -1):
            force, moment = _add(force, forces[index]), _add(moment, moments[index])
            torques[index] = force[2] if self._slides[index] else moment[2]
            rotation, step = chain[index]
            force = _to_parent(rotation, force)
            moment = _add(_to_parent(rotation, moment), _cross(step, force))
        return torques


_RESTING_BASE: tuple[Three, Three, Three] = (ZERO, ZERO, (0.0, 0.0, GRAVITY))
"""ω, α and a of a base that is bolted down; gravity counts as an upward acceleration."""


def _base_motion(v: list[float], acceleration: list[float]) -> tuple[Three, Three, Three]:
    """ω, α and a of a base with the controls (v, ω): it turns about its axle and never moves sideways."""
    return (0.0, 0.0, v[1]), (0.0, 0.0, acceleration[1]), (acceleration[0], v[0] * v[1], GRAVITY)


def _body_wrench(body: FrameMass, spin: Three, turn: Three, linear: Three) -> tuple[Three, Three]:
    """Force, and moment about the frame's origin, that move the bodies on a frame."""
    if not body.mass:
        return ZERO, ZERO
    force = _scale(body.mass, _point_acceleration(spin, turn, linear, body.centre))
    moment = _add(_times(body.inertia, turn), _cross(spin, _times(body.inertia, spin)))
    return force, _add(moment, _cross(body.centre, force))


def _point_acceleration(spin: Three, turn: Three, linear: Three, point: Three) -> Three:
    """A + α × p + ω × (ω × p)."""
    wx, wy, wz = spin
    ax, ay, az = turn
    px, py, pz = point
    ux, uy, uz = wy * pz - wz * py, wz * px - wx * pz, wx * py - wy * px
    return (
        linear[0] + ay * pz - az * py + wy * uz - wz * uy,
        linear[1] + az * px - ax * pz + wz * ux - wx * uz,
        linear[2] + ax * py - ay * px + wx * uy - wy * ux,
    )


def _to_child(rotation: Rotation, vector: Three) -> Three:
    """Rᵀ times a vector."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    x, y, z = vector
    return (a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z)


def _to_parent(rotation: Rotation, vector: Three) -> Three:
    """R times a vector."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    x, y, z = vector
    return (a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z)


def _times(inertia: tuple[float, float, float, float, float, float], vector: Three) -> Three:
    """A symmetric matrix (xx, yy, zz, xy, xz, yz) times a vector."""
    xx, yy, zz, xy, xz, yz = inertia
    x, y, z = vector
    return (xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z)


def _add(a: Three, b: Three) -> Three:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def _scale(factor: float, a: Three) -> Three:
    return (factor * a[0], factor * a[1], factor * a[2])


def _cross(a: Three, b: Three) -> Three:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _columns(matrix: Array) -> Rotation:
    x, y, z = matrix.T.tolist()
    return (tuple(x), tuple(y), tuple(z))


def combine_bodies(bodies: list[RigidBody]) -> FrameMass:
    """The bodies on one frame as one body."""
    mass = sum(body.mass for body in bodies)
    if not mass:
        return FrameMass(mass=0.0, centre=ZERO, inertia=NO_INERTIA)
    centre = sum((body.mass * np.array(body.centre) for body in bodies), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for body in bodies:
        xx, yy, zz, xy, xz, yz = body.inertia
        arm = np.array(body.centre) - centre
        inertia += np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        inertia += body.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = inertia.tolist()
    x, y, z = centre.tolist()
    return FrameMass(mass=mass, centre=(x, y, z), inertia=(xx, yy, zz, xy, xz, yz))


def _tool_in_last_frame(robot_model: RobotModel) -> Three:
    """Origin of the tool frame in the last frame of the chain [m]."""
    link = next(link for link in robot_model.links if link.name == robot_model.tool.link)
    offset = quaternion_to_matrix(link.quaternion) @ np.array(robot_model.tool.translation)
    x, y, z = (np.array(link.translation) + offset).tolist()
    return (x, y, z)
