"""The independent judge of safety: watches simulator truth and writes down every breach.

It shares nothing with the filter: no h values, no spheres, no perceived scene. Contacts come from the collision
shapes of the model, forces from the contact solver, joints and poses from the simulator's state. Breaches in
consecutive ticks of the same kind between the same bodies are one `Violation`.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import mujoco
import numpy as np

from dualbrain.records import Violation
from dualbrain.world.contact_rules import ENVIRONMENT, HUMAN, Allowance, ContactRules
from dualbrain.world.plant import Plant
from dualbrain.world.scene_builder import PREFIX
from dualbrain.world.thing_watch import ThingWatch

SETTLE = 0.3  # [s] before anything is judged
MERGE = 0.05  # [s] of quiet that still belong to the same breach
CONTACT_FORCE = 1.0  # [N] below which a touch of the environment does not count
JOINT_TOLERANCE = 1e-3  # [rad]
SPEED_TOLERANCE = 1.01
SLOW_EVERY = 10  # ticks between looks at poses and tool speed

UNITS = {
    "collision_env": "N", "collision_human": "N", "self_collision": "N", "force_fragile": "N", "joint_limit": "rad",
    "joint_velocity": "rad/s", "tcp_speed": "m/s", "object_dropped": "m", "bystander": "m", "bystander_tilt": "rad",
}  # fmt: skip
"""Kinds of breach and the unit of their peak; a bystander is moved (m) or tilted (rad)."""


@dataclass
class _Breach:
    kind: str
    bodies: tuple[str, ...]
    start: float
    last: float
    peak: float
    perceived: bool


class Monitor:
    """Judge one plant: `tick()` after every `advance()`, `violations()` at any time."""

    def __init__(self, plant: Plant) -> None:
        """Index geoms, joints and limits; nothing is allowed until `allow`, everything counts as perceived."""
        self._plant, self._model, self._data = plant, plant.model, plant.data
        self._rules = ContactRules(plant.model, plant.spec)
        self._things = ThingWatch(plant)
        joints = plant.body.joints
        self._lower = np.array([joint.lower.value for joint in joints]) - JOINT_TOLERANCE
        self._upper = np.array([joint.upper.value for joint in joints]) + JOINT_TOLERANCE
        self._fastest = SPEED_TOLERANCE * np.array([joint.velocity.value for joint in joints])
        self._tool_speed = plant.body.tool_speed.value
        self._tool = int(plant.model.site(f"{PREFIX}tcp").id)
        self._qpos, self._dofs = plant.arm_slices
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
        self._judged = (
            (self._verdicts != 0) | np.isfinite(self._rules.fragile)[:, None] | np.isfinite(self._rules.fragile)
        )
        self._things.allow(allowance)

    def perceive(self, names: Iterable[str]) -> None:
        """Tell which things the robot perceives now; a breach with any other thing is marked `perceived = False`."""
        self._perceived = frozenset(names) | {"table", "floor"}

    def tick(self) -> None:
        """Judge the state after one control period."""
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
        pairs = self._data.contact.geom
        for index in self._judged[pairs[:, 0], pairs[:, 1]].nonzero()[0].tolist():
            self._contact(index, int(pairs[index, 0]), int(pairs[index, 1]), now)

    def _contact(self, index: int, first: int, second: int, now: float) -> None:
        mujoco.mj_contactForce(self._model, self._data, index, self._wrench)
        force, rules = float(self._wrench[0]), self._rules
        bodies = tuple(sorted(rules.owner[geom].removeprefix(PREFIX) for geom in (first, second)))
        limit = min(rules.fragile[first], rules.fragile[second])
        if force > limit:
            self._breach("force_fragile", bodies, force, now)
        verdict = int(self._verdicts[first, second])
        if verdict == HUMAN:
            self._breach("collision_human", bodies, force, now)
        elif verdict == ENVIRONMENT:
            if force > CONTACT_FORCE:
                self._breach("collision_env", bodies, force, now)
        elif verdict:
            self._breach("self_collision", bodies, force, now)

    def _joints(self, now: float) -> None:
        q, v = self._data.qpos[self._qpos], self._data.qvel[self._dofs]
        fast = abs(v) > self._fastest
        if fast.any():
            for joint in fast.nonzero()[0].tolist():
                self._breach("joint_velocity", (f"joint{joint + 1}",), abs(float(v[joint])), now)
        out = (q < self._lower) | (q > self._upper)
        if out.any():
            for joint in out.nonzero()[0].tolist():
                past = max(self._lower[joint] - q[joint], q[joint] - self._upper[joint]) + JOINT_TOLERANCE
                self._breach("joint_limit", (f"joint{joint + 1}",), float(past), now)

    def _slow(self, now: float) -> None:
        motion = np.zeros(6)
        mujoco.mj_objectVelocity(self._model, self._data, mujoco.mjtObj.mjOBJ_SITE, self._tool, motion, 0)
        speed = float(np.linalg.norm(motion[3:]))
        if speed > self._tool_speed * SPEED_TOLERANCE:
            self._breach("tcp_speed", ("tcp",), speed, now)
        for kind, name, peak in self._things.look(self._rules):
            self._breach(kind, (name,), peak, now, hold=SLOW_EVERY * 1e-3)

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
