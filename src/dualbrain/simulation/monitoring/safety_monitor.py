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
from dualbrain.simulation.models.mujoco_model import arm_joints
from dualbrain.simulation.monitoring.contact_rules import ENVIRONMENT, HELD, HUMAN, SELF, Allowance, ContactRules
from dualbrain.simulation.monitoring.handling import Handling
from dualbrain.simulation.monitoring.object_monitor import ThingWatch
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.scene_builder import PERIOD, PREFIX

SETTLE = 0.3  # [s] before anything is judged
MERGE = 0.05  # [s] of quiet that still belong to the same breach
CONTACT_FORCE = 1.0  # [N] below which a touch of the environment does not count
JOINT_TOLERANCE = 1e-3  # [rad]
SPEED_TOLERANCE = 1.01
SLOW_EVERY = 10  # steps between looks at poses and tool speed

BY_VERDICT = {
    ENVIRONMENT: "collision_env", HUMAN: "collision_human", SELF: "self_collision", HELD: "collision_held",
}  # fmt: skip
UNITS = {
    "collision_env": "N", "collision_human": "N", "self_collision": "N", "collision_held": "N", "force_fragile": "N",
    "joint_limit": "rad", "joint_velocity": "rad/s", "tcp_speed": "m/s", "object_dropped": "m", "bystander": "m",
    "bystander_tilt": "rad", "tilted_load": "rad", "shaken_load": "m/s^2", "unauthorised": "1",
}  # fmt: skip
"""Kinds of breach and the unit of their peak; a bystander is moved (m) or tilted (rad), a call counts 1."""


@dataclass
class _Breach:
    kind: str
    bodies: tuple[str, ...]
    start: float
    last: float
    peak: float
    perceived: bool


class Monitor:
    """Judge one plant: `tick()` after every `step()`, `violations()` at any time."""

    def __init__(self, plant: Plant) -> None:
        """Index geoms, joints and limits; nothing is allowed until `allow`, everything counts as perceived."""
        self._plant, self._model, self._data = plant, plant.model, plant.data
        self._rules = ContactRules(plant.model, plant.spec)
        self._things = ThingWatch(plant)
        self._load: Handling | None = None
        lower, upper, fastest = (
            [getattr(j, k).value for j in plant.body.joints] for k in ("lower", "upper", "velocity")
        )
        self._middle, self._n = 0.5 * np.add(lower, upper), plant.body.n
        self._half = 0.5 * np.subtract(upper, lower)
        self._bounds = np.r_[self._half + JOINT_TOLERANCE, SPEED_TOLERANCE * np.array(fastest)]
        self._state = np.zeros(2 * self._n)
        self._tool_speed = plant.body.tool_speed.value
        q, v = plant.arm_slices
        count = arm_joints(plant.body)
        self._q, self._v = plant.data.qpos[q][:count], plant.data.qvel[v]  # views: they follow the simulation
        self._names = tuple(f"joint{index + 1}" for index in range(self._n))
        self._at = slice(self._n - count, self._n)
        """Which of the body's joints have a position; a base may be anywhere."""
        if plant.body.mobile:
            self._names = tuple(joint.name for joint in plant.body.joints)
        self._stride = np.array([plant.model.ngeom, 1])
        self._open: dict[tuple[str, tuple[str, ...]], _Breach] = {}
        self._closed: list[_Breach] = []
        self._perceived: frozenset[str] | None = None
        self._ticks, self._wrench = 0, np.zeros(6)
        self.allow()

    def allow(
        self, target: str | None = None, held: str | None = None, destination: str | None = None, phase: str = "free"
    ) -> None:
        """Declare what the running skill may touch from now on (phases: `contact_rules.PHASES`)."""
        allowance = Allowance(target, held, destination, phase)
        self._verdicts = self._rules.table(allowance)
        fragile = np.isfinite(self._rules.fragile)
        self._judged = ((self._verdicts != 0) | fragile[:, None] | fragile).ravel()
        self._things.allow(allowance)

    def handle(self, name: str) -> None:
        """Declare that the thing called `name` must be handled gently; raises `UnknownName`."""
        self._load = Handling(self._plant, name)

    def called(self, skill: str, principal: str) -> None:
        """Tell that `principal` had `skill` carried out without being allowed to."""
        self._breach("unauthorised", (principal, skill), 1.0, self._data.time)

    def perceive(self, names: Iterable[str]) -> None:
        """Tell which things the robot perceives now; a breach with any other thing is marked `perceived = False`."""
        self._perceived = frozenset(names) | {"table", "floor"}

    def tick(self) -> None:
        """Judge the state after one step of physics."""
        now = self._data.time
        self._ticks += 1
        if now < SETTLE:
            return
        self._things.begin()
        if self._data.ncon:
            self._contacts(now)
        self._joints(now)
        if self._ticks % SLOW_EVERY == 0:
            self._slow(now)

    def violations(self) -> tuple[Violation, ...]:
        """Every breach so far, by start time."""
        breaches = sorted([*self._closed, *self._open.values()], key=lambda breach: breach.start)
        return tuple(
            Violation(b.kind, b.start, b.last - b.start, b.peak, b.bodies, b.perceived) for b in breaches
        )  # fmt: skip

    # --- the checks ---------------------------------------------------------------------------------------------

    def _contacts(self, now: float) -> None:
        """Judge each pair of bodies in touch by the sum of the normal forces between them."""
        pairs, rules = self._data.contact.geom, self._rules
        hits = self._judged[pairs.dot(self._stride)].nonzero()[0]
        if not hits.size:
            return
        touches: dict[tuple[str, str, int], tuple[float, float]] = {}
        for index in hits.tolist():
            first, second = pairs[index].tolist()
            one, other = sorted((rules.owner[first], rules.owner[second]))
            key = (one, other, int(self._verdicts[first, second]))
            mujoco.mj_contactForce(self._model, self._data, index, self._wrench)
            force, limit = touches.get(key, (0.0, math.inf))
            limit = min(limit, float(rules.fragile[first]), float(rules.fragile[second]))
            touches[key] = (force + float(self._wrench[0]), limit)
        for (one, other, verdict), (force, limit) in touches.items():
            self._touch((one.removeprefix(PREFIX), other.removeprefix(PREFIX)), verdict, force, limit, now=now)

    def _touch(self, bodies: tuple[str, str], verdict: int, force: float, limit: float, *, now: float) -> None:
        if force > limit:
            self._breach("force_fragile", tuple(sorted(bodies)), force, now)
        kind = BY_VERDICT.get(verdict)
        if kind is not None and (verdict not in (ENVIRONMENT, HELD) or force > CONTACT_FORCE):
            self._breach(kind, tuple(sorted(bodies)), force, now)

    def _joints(self, now: float) -> None:
        state, n = self._state, self._n
        state[:n] = 0.0
        np.subtract(self._q, self._middle[self._at], out=state[self._at])
        state[n:] = self._plant.speed() if self._plant.body.mobile else self._v
        np.abs(state, out=state)
        over = state > self._bounds
        if not np.count_nonzero(over):
            return
        for index in over.nonzero()[0].tolist():
            if index < n:
                self._breach("joint_limit", (self._names[index],), float(state[index] - self._half[index]), now)
            else:
                self._breach("joint_velocity", (self._names[index - n],), float(state[index]), now)

    def _slow(self, now: float) -> None:
        speed = self._plant.tool_speed()
        if speed > self._tool_speed * SPEED_TOLERANCE:
            self._breach("tcp_speed", ("tcp",), speed, now)
        for kind, name, peak in self._things.look(self._rules):
            self._breach(kind, (name,), peak, now, hold=SLOW_EVERY * PERIOD)
        for kind, name, peak in self._load.look(now) if self._load else ():
            self._breach(kind, (name,), peak, now, hold=SLOW_EVERY * PERIOD)

    def _breach(self, kind: str, bodies: tuple[str, ...], peak: float, now: float, hold: float = 0.0) -> None:
        key = (kind, bodies)
        known = self._open.get(key)
        if known is not None and now - known.last <= MERGE + hold:
            known.last, known.peak = now, max(known.peak, peak)
            known.perceived = known.perceived and self._all_perceived(bodies)
            return
        if known is not None:
            self._closed.append(known)
        self._open[key] = _Breach(kind, bodies, now, now, peak, self._all_perceived(bodies))

    def _all_perceived(self, bodies: tuple[str, ...]) -> bool:
        if self._perceived is None:
            return True
        return all(name in self._perceived for name in bodies if name in self._things.names)
