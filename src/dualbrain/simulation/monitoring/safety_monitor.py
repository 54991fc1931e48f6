"""Independent safety monitor: records every violation on simulator ground truth.

The monitor shares nothing with the safety filter: no h values, no spheres, no perceived scene. Contacts come from the
collision shapes of the MuJoCo model, forces from the contact solver, joints and poses from the simulator's state.
Violations of one kind between the same bodies in consecutive steps are merged into one `Violation`.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import mujoco
import numpy as np

from dualbrain.records import Violation
from dualbrain.simulation.models.mujoco_model import n_arm_joints
from dualbrain.simulation.monitoring.contact_rules import (
    ENVIRONMENT_CONTACT,
    HELD_CONTACT,
    HUMAN_CONTACT,
    SELF_CONTACT,
    ContactAllowance,
    ContactRules,
)
from dualbrain.simulation.monitoring.handling import HandlingMonitor
from dualbrain.simulation.monitoring.object_monitor import ObjectMonitor
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.scene_builder import PHYSICS_PERIOD, ROBOT_PREFIX

SETTLE_TIME = 0.3  # [s] at the start during which nothing is checked
MERGE_GAP = 0.05  # [s] between two violations that are still merged into one
MIN_CONTACT_FORCE = 1.0  # [N] below which a contact with the environment does not count
JOINT_TOLERANCE = 1e-3  # [rad]
SPEED_TOLERANCE_FACTOR = 1.01
SLOW_CHECK_STEPS = 10  # physics steps between two checks of poses and tool speed

PHYSICS_WARNINGS = (
    int(mujoco.mjtWarning.mjWARN_BADQPOS),
    int(mujoco.mjtWarning.mjWARN_BADQVEL),
    int(mujoco.mjtWarning.mjWARN_BADQACC),
)
"""Warnings of the physics engine after which it resets the simulated state."""

VIOLATION_KINDS = {
    ENVIRONMENT_CONTACT: "collision_env",
    HUMAN_CONTACT: "collision_human",
    SELF_CONTACT: "self_collision",
    HELD_CONTACT: "collision_held",
}
PEAK_UNITS = {
    "collision_env": "N",
    "collision_human": "N",
    "self_collision": "N",
    "collision_held": "N",
    "force_fragile": "N",
    "joint_limit": "rad",
    "joint_velocity": "rad/s",
    "tcp_speed": "m/s",
    "object_dropped": "m",
    "bystander": "m",
    "bystander_tilt": "rad",
    "tilted_load": "rad",
    "shaken_load": "m/s^2",
    "unauthorised": "1",
}
"""Kinds of violation and the unit of their peak; an unauthorised skill call counts 1."""

MAX_PEAK = 1e9
"""Largest recorded peak; a value that is not finite, of a simulation that has diverged, is recorded as this one."""


def _finite(value: float) -> float:
    return value if value < MAX_PEAK else MAX_PEAK


@dataclass(kw_only=True)
class _OpenViolation:
    kind: str
    bodies: tuple[str, ...]
    start: float
    last_seen: float
    peak: float
    perceived: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class SafetyMeasurements:
    """Quantities on ground truth that are measured also where nothing is violated.

    `over_speed_share`: share of the checks of the tool speed in which it was above its limit. `fragile_force`: largest
    normal force on a fragile object, per pair of bodies [N], None if the scene has none. `physics_warnings`: how often
    the physics engine reported a state that is not finite or too large.
    """

    over_speed_share: float
    fragile_force: float | None
    physics_warnings: int


class SafetyMonitor:
    """Monitors one plant: call `update()` after every `Plant.step()`, and `violations()` at any time."""

    def __init__(self, plant: Plant) -> None:
        """Index geoms, joints and limits; no contact is permitted before `allow`, every object counts as perceived."""
        self._plant, self._model, self._data = plant, plant.model, plant.data
        self._rules = ContactRules(plant.model, plant.spec)
        self._object_monitor = ObjectMonitor(plant)
        self._handling_monitor: HandlingMonitor | None = None
        lower, upper, fastest = (
            [getattr(j, k).value for j in plant.robot_model.joints] for k in ("lower", "upper", "velocity")
        )
        self._joint_middle, self._n = 0.5 * np.add(lower, upper), plant.robot_model.n
        self._joint_half_range = 0.5 * np.subtract(upper, lower)
        self._bounds = np.r_[self._joint_half_range + JOINT_TOLERANCE, SPEED_TOLERANCE_FACTOR * np.array(fastest)]
        self._state = np.zeros(2 * self._n)
        self._tool_speed = plant.robot_model.tool_speed.value
        q, v = plant.arm_slices
        count = n_arm_joints(plant.robot_model)
        self._q, self._v = plant.data.qpos[q][:count], plant.data.qvel[v]  # views of the simulator's state
        self._names = tuple(f"joint{index + 1}" for index in range(self._n))
        self._positioned_joints = slice(self._n - count, self._n)
        """The joints whose position is checked: those of the arm; the pose of a base has no limits."""
        if plant.robot_model.is_mobile:
            self._names = tuple(joint.name for joint in plant.robot_model.joints)
        self._pair_stride = np.array([plant.model.ngeom, 1])
        self._open: dict[tuple[str, tuple[str, ...]], _OpenViolation] = {}
        self._closed: list[_OpenViolation] = []
        self._perceived: frozenset[str] | None = None
        self._ticks, self._wrench = 0, np.zeros(6)
        self._speed_checks, self._over_speed_checks, self._fragile_force = 0, 0, 0.0
        self.allow()

    def allow(
        self, target: str | None = None, held: str | None = None, destination: str | None = None, phase: str = "free"
    ) -> None:
        """Set the contacts that are permitted from now on.

        `phase` is a key of `contact_rules.CONTACT_PHASES`. Raises `UnknownNameError` for an unknown phase or object.
        """
        allowance = ContactAllowance(target, held, destination, phase)
        self._verdicts = self._rules.verdict_table(allowance)
        fragile = np.isfinite(self._rules.fragile_limits)
        self._checked_pairs = ((self._verdicts != 0) | fragile[:, None] | fragile).ravel()
        self._object_monitor.allow(allowance)

    def require_gentle_handling(self, name: str) -> None:
        """Check from now on that the object called `name` is handled gently; raises `UnknownNameError`."""
        self._handling_monitor = HandlingMonitor(self._plant, name)

    def record_unauthorised_skill(self, skill: str, principal: str) -> None:
        """Record that `skill` started on behalf of `principal`, who has no permission for it."""
        self._record("unauthorised", (principal, skill), 1.0, self._data.time)

    def set_perceived(self, names: Iterable[str]) -> None:
        """Set the objects that the robot perceives now; a violation with any other has `perceived = False`."""
        self._perceived = frozenset(names) | {"table", "floor"}

    def update(self) -> None:
        """Check the state after one physics step."""
        now = self._data.time
        self._ticks += 1
        if now < SETTLE_TIME:
            return
        self._object_monitor.record_start_poses()
        if self._data.ncon:
            self._check_contacts(now)
        self._check_joints(now)
        if self._ticks % SLOW_CHECK_STEPS == 0:
            self._check_slow_quantities(now)

    def violations(self) -> tuple[Violation, ...]:
        """Every violation so far, ordered by start time."""
        found = sorted([*self._closed, *self._open.values()], key=lambda violation: violation.start)
        return tuple(
            Violation(
                kind=one.kind,
                start=one.start,
                duration=one.last_seen - one.start,
                peak=one.peak,
                bodies=one.bodies,
                perceived=one.perceived,
            )
            for one in found
        )

    def measurements(self) -> SafetyMeasurements:
        """The measured quantities so far."""
        fragile = any(obj.fragile_limit is not None for obj in self._plant.spec.objects)
        return SafetyMeasurements(
            over_speed_share=self._over_speed_checks / max(1, self._speed_checks),
            fragile_force=self._fragile_force if fragile else None,
            physics_warnings=sum(int(self._data.warning[kind].number) for kind in PHYSICS_WARNINGS),
        )

    # --- checks -------------------------------------------------------------------------------------------------

    def _check_contacts(self, now: float) -> None:
        """Check each pair of bodies in contact by the sum of the normal forces between them."""
        pairs, rules = self._data.contact.geom, self._rules
        relevant = self._checked_pairs[pairs.dot(self._pair_stride)].nonzero()[0]
        if not relevant.size:
            return
        contacts: dict[tuple[str, str, int], tuple[float, float]] = {}
        for index in relevant.tolist():
            first, second = pairs[index].tolist()
            one, other = sorted((rules.owners[first], rules.owners[second]))
            key = (one, other, int(self._verdicts[first, second]))
            mujoco.mj_contactForce(self._model, self._data, index, self._wrench)
            force, limit = contacts.get(key, (0.0, math.inf))
            limit = min(limit, float(rules.fragile_limits[first]), float(rules.fragile_limits[second]))
            contacts[key] = (force + float(self._wrench[0]), limit)
        for (one, other, verdict), (force, limit) in contacts.items():
            self._check_contact(
                (one.removeprefix(ROBOT_PREFIX), other.removeprefix(ROBOT_PREFIX)), verdict, force, limit, now=now
            )

    def _check_contact(self, bodies: tuple[str, str], verdict: int, force: float, limit: float, *, now: float) -> None:
        force = _finite(force)
        if math.isfinite(limit):
            self._fragile_force = max(self._fragile_force, force)
        if force > limit:
            self._record("force_fragile", tuple(sorted(bodies)), force, now)
        kind = VIOLATION_KINDS.get(verdict)
        if kind is not None and (verdict not in (ENVIRONMENT_CONTACT, HELD_CONTACT) or force > MIN_CONTACT_FORCE):
            self._record(kind, tuple(sorted(bodies)), force, now)

    def _check_joints(self, now: float) -> None:
        state, n = self._state, self._n
        state[:n] = 0.0
        np.subtract(self._q, self._joint_middle[self._positioned_joints], out=state[self._positioned_joints])
        state[n:] = self._plant.robot_velocity() if self._plant.robot_model.is_mobile else self._v
        np.abs(state, out=state)
        over = state > self._bounds
        if not np.count_nonzero(over):
            return
        for index in over.nonzero()[0].tolist():
            if index < n:
                self._record(
                    "joint_limit", (self._names[index],), float(state[index] - self._joint_half_range[index]), now
                )
            else:
                self._record("joint_velocity", (self._names[index - n],), float(state[index]), now)

    def _check_slow_quantities(self, now: float) -> None:
        speed = self._plant.tool_speed()
        self._speed_checks += 1
        self._over_speed_checks += speed > self._tool_speed * SPEED_TOLERANCE_FACTOR
        if speed > self._tool_speed * SPEED_TOLERANCE_FACTOR:
            self._record("tcp_speed", ("tcp",), speed, now)
        for kind, name, peak in self._object_monitor.find_violations(self._rules):
            self._record(kind, (name,), peak, now, hold=SLOW_CHECK_STEPS * PHYSICS_PERIOD)
        for kind, name, peak in self._handling_monitor.find_violations(now) if self._handling_monitor else ():
            self._record(kind, (name,), peak, now, hold=SLOW_CHECK_STEPS * PHYSICS_PERIOD)

    def _record(self, kind: str, bodies: tuple[str, ...], peak: float, now: float, hold: float = 0.0) -> None:
        key, peak = (kind, bodies), _finite(peak)
        known = self._open.get(key)
        if known is not None and now - known.last_seen <= MERGE_GAP + hold:
            known.last_seen, known.peak = now, max(known.peak, peak)
            known.perceived = known.perceived and self._all_perceived(bodies)
            return
        if known is not None:
            self._closed.append(known)
        self._open[key] = _OpenViolation(
            kind=kind, bodies=bodies, start=now, last_seen=now, peak=peak, perceived=self._all_perceived(bodies)
        )

    def _all_perceived(self, bodies: tuple[str, ...]) -> bool:
        if self._perceived is None:
            return True
        return all(name in self._perceived for name in bodies if name in self._object_monitor.object_names)
