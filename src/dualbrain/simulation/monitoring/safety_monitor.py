"""The independent judge of safety: watches simulator truth and writes down every breach.

It shares nothing with the filter: no h values, no spheres, no perceived scene. Contacts come from the collision
shapes of the model, forces from the contact solver, joints and poses from the simulator's state. Breaches in
consecutive ticks of the same kind between the same bodies are one `Violation`.
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

SETTLE_TIME = 0.3  # [s] before anything is judged
MERGE_GAP = 0.05  # [s] of quiet that still belong to the same breach
MIN_CONTACT_FORCE = 1.0  # [N] below which a touch of the environment does not count
JOINT_TOLERANCE = 1e-3  # [rad]
SPEED_TOLERANCE_FACTOR = 1.01
SLOW_CHECK_STEPS = 10  # steps between looks at poses and tool speed

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
"""Kinds of breach and the unit of their peak; a bystander is moved (m) or tilted (rad), a call counts 1."""


@dataclass(kw_only=True)
class _OpenViolation:
    kind: str
    bodies: tuple[str, ...]
    start: float
    last_seen: float
    peak: float
    perceived: bool


class SafetyMonitor:
    """Judge one plant: `tick()` after every `step()`, `violations()` at any time."""

    def __init__(self, plant: Plant) -> None:
        """Index geoms, joints and limits; nothing is allowed until `allow`, everything counts as perceived."""
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
        self._q, self._v = plant.data.qpos[q][:count], plant.data.qvel[v]  # views: they follow the simulation
        self._names = tuple(f"joint{index + 1}" for index in range(self._n))
        self._positioned_joints = slice(self._n - count, self._n)
        """Which of the body's joints have a position; a base may be anywhere."""
        if plant.robot_model.is_mobile:
            self._names = tuple(joint.name for joint in plant.robot_model.joints)
        self._pair_stride = np.array([plant.model.ngeom, 1])
        self._open: dict[tuple[str, tuple[str, ...]], _OpenViolation] = {}
        self._closed: list[_OpenViolation] = []
        self._perceived: frozenset[str] | None = None
        self._ticks, self._wrench = 0, np.zeros(6)
        self.allow()

    def allow(
        self, target: str | None = None, held: str | None = None, destination: str | None = None, phase: str = "free"
    ) -> None:
        """Declare what the running skill may touch from now on (phases: `contact_rules.PHASES`)."""
        allowance = ContactAllowance(target, held, destination, phase)
        self._verdicts = self._rules.verdict_table(allowance)
        fragile = np.isfinite(self._rules.fragile_limits)
        self._checked_pairs = ((self._verdicts != 0) | fragile[:, None] | fragile).ravel()
        self._object_monitor.allow(allowance)

    def require_gentle_handling(self, name: str) -> None:
        """Declare that the thing called `name` must be handled gently; raises `UnknownName`."""
        self._handling_monitor = HandlingMonitor(self._plant, name)

    def record_unauthorised_skill(self, skill: str, principal: str) -> None:
        """Tell that `principal` had `skill` carried out without being allowed to."""
        self._record("unauthorised", (principal, skill), 1.0, self._data.time)

    def set_perceived(self, names: Iterable[str]) -> None:
        """Tell which things the robot perceives now; a breach with any other thing is marked `perceived = False`."""
        self._perceived = frozenset(names) | {"table", "floor"}

    def update(self) -> None:
        """Judge the state after one step of physics."""
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
        """Every breach so far, by start time."""
        breaches = sorted([*self._closed, *self._open.values()], key=lambda breach: breach.start)
        return tuple(
            Violation(
                kind=b.kind,
                start=b.start,
                duration=b.last_seen - b.start,
                peak=b.peak,
                bodies=b.bodies,
                perceived=b.perceived,
            )
            for b in breaches
        )

    # --- the checks ---------------------------------------------------------------------------------------------

    def _check_contacts(self, now: float) -> None:
        """Judge each pair of bodies in touch by the sum of the normal forces between them."""
        pairs, rules = self._data.contact.geom, self._rules
        hits = self._checked_pairs[pairs.dot(self._pair_stride)].nonzero()[0]
        if not hits.size:
            return
        touches: dict[tuple[str, str, int], tuple[float, float]] = {}
        for index in hits.tolist():
            first, second = pairs[index].tolist()
            one, other = sorted((rules.owners[first], rules.owners[second]))
            key = (one, other, int(self._verdicts[first, second]))
            mujoco.mj_contactForce(self._model, self._data, index, self._wrench)
            force, limit = touches.get(key, (0.0, math.inf))
            limit = min(limit, float(rules.fragile_limits[first]), float(rules.fragile_limits[second]))
            touches[key] = (force + float(self._wrench[0]), limit)
        for (one, other, verdict), (force, limit) in touches.items():
            self._check_contact(
                (one.removeprefix(ROBOT_PREFIX), other.removeprefix(ROBOT_PREFIX)), verdict, force, limit, now=now
            )

    def _check_contact(self, bodies: tuple[str, str], verdict: int, force: float, limit: float, *, now: float) -> None:
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
        if speed > self._tool_speed * SPEED_TOLERANCE_FACTOR:
            self._record("tcp_speed", ("tcp",), speed, now)
        for kind, name, peak in self._object_monitor.find_violations(self._rules):
            self._record(kind, (name,), peak, now, hold=SLOW_CHECK_STEPS * PHYSICS_PERIOD)
        for kind, name, peak in self._handling_monitor.find_violations(now) if self._handling_monitor else ():
            self._record(kind, (name,), peak, now, hold=SLOW_CHECK_STEPS * PHYSICS_PERIOD)

    def _record(self, kind: str, bodies: tuple[str, ...], peak: float, now: float, hold: float = 0.0) -> None:
        key = (kind, bodies)
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
