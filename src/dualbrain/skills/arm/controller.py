"""The limb: what every skill can do with an arm, each as a short story of nominal controls.

A part yields one `Nominal` a tick (or None while it thinks, see `thought`) and returns None when it went well or the
`Ending` that stops the skill.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import replace
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from dualbrain.contracts.skill_spec import SkillSpec
from dualbrain.errors import InvalidSetup
from dualbrain.records import SceneObject
from dualbrain.robots.model import Body
from dualbrain.skills.human_prediction import threat
from dualbrain.skills.kinematics.clearance_prediction import LEAVING, Foresight, Goal, View
from dualbrain.skills.kinematics.inverse_kinematics import BRIEF, InverseKinematics
from dualbrain.skills.kinematics.object_geometry import bottom, top
from dualbrain.skills.kinematics.resolved_rate import ResolvedRate, gap_to
from dualbrain.skills.progress_watchdog import STANDSTILL, Progress
from dualbrain.skills.skill import Ending, Holding, Motion, Nominal, Senses, Status, Touch
from dualbrain.skills.time_slicing import Thought

Array = NDArray[np.float64]
Part = Generator[Nominal | None, None, Ending | None]

SETTLED = 0.15
"""How long [s] a grip must stand still and press with both fingers to count as a grasp."""
GRIP_FORCE_MIN = 0.5
"""Force on each finger that counts as contact [N] (two-finger test)."""
OWN_LIMIT = 0.95
"""Share of the allowed tool speed that φ uses: posture and rotation move the tool as well."""
CEILING = 0.50
"""Tool height that no evasion exceeds [m]."""
YIELD_SPEED = 0.30
"""How fast the arm gets out of a person's way [m/s]."""
BESIDE = 0.17
"""Half the hand's breadth and some air: whoever stays this far beside the tool does not bother it [m]."""
YIELDED = Ending(Status.RUNNING, "yielded to a person")
"""A part ended because a person came by; the way is free again, and the part may be tried again."""
PERSON_PATIENCE = 20.0
"""How long [s] a skill waits for a person before it says so and fails."""


class Limb:
    """One arm with its gripper, as the skills move it. State: φ's memory, the grip, and the current senses."""

    def __init__(self, body: Body, motion: Motion) -> None:
        """Bind to a body and to what the local layer lends; call `sense` before every step of a story."""
        self.body = body
        self.kinematics = InverseKinematics(body, motion.tool)
        self.holding: Holding | None = None
        self.opening = body.gripper.opening.value
        self.force = body.gripper.force_min.value
        self._phi = ResolvedRate(body, motion)
        self._foresight = Foresight(body, motion)
        self._senses: Senses | None = None
        self._touches: dict[str, tuple[Touch, ...]] = {}
        self._known: tuple[str, ...] = ()
        self._looked_at: tuple[float, float, float, bool] | None = None
        self._threat: float | None = None

    # --- senses -------------------------------------------------------------------------------------------------

    def sense(self, senses: Senses) -> None:
        """Take in this tick's senses."""
        self._senses = senses

    @property
    def senses(self) -> Senses:
        """This tick's senses."""
        if self._senses is None:
            raise InvalidSetup("a limb without senses", got=None, allowed="one call of `sense` before the first tick")
        return self._senses

    def see(self, name: str) -> SceneObject:
        """The thing called `name` as perceived now."""
        return self.senses.scene.find(name)

    def begin(self, spec: SkillSpec, **others: str | None) -> None:
        """Start a skill: its declared contact permits hold by phase, for the named target, destination and support."""
        touches: dict[str, list[Touch]] = {}
        for permit in spec.permits:
            obstacle = others.get(permit.other)
            if obstacle is not None:
                touches.setdefault(permit.phase, []).append(Touch(permit.robot_part, obstacle, permit.speed))
        self._touches = {phase: tuple(pairs) for phase, pairs in touches.items()}
        self._known = tuple(name for name in others.values() if name)

    @property
    def support(self) -> SceneObject | None:
        """The surface that things stand on, if one is perceived."""
        return next((thing for thing in self.senses.scene.objects if thing.role == "support"), None)

    @property
    def floor(self) -> float:
        """Height of the support surface [m]."""
        return top(self.support) if self.support else 0.0

    # --- parts of a story ---------------------------------------------------------------------------------------

    def reach(
        self, goal: Goal, phase: str, speed: float, *, stop: bool = True, patience: float = STANDSTILL
    ) -> Part:  # fmt: skip
        """Move the tool to `goal`; with `stop` come to rest there, else pass by.

        When a person is about to sweep by, the arm gets out of the way and the part ends with `YIELDED`.
        """
        speed = min(speed, OWN_LIMIT * self.body.tool_speed.value)
        near, turned = (0.003, 0.02) if stop else (0.02, 0.3)
        progress = Progress(self.senses.patience, limit=4.0 + 3.0 * self._distance(goal) / speed, patience=patience)
        while True:
            tool, state, now = self.senses.tool, self.senses.state, self.senses.now
            gap = gap_to(tool, goal.position, goal.rotation)
            distance, turn = gap.distance, gap.angle
            if distance < near and turn < turned:
                return None
            if (height := self.threatened(tool.position)) is not None:
                return (yield from self.step_aside(phase, height))
            if why := progress.stuck(self.senses.patience, distance + 0.1 * turn):
                return Ending(Status.TAKEN_OVER, f"{phase}: {why}, {distance * 100:.1f} cm from the goal")
            yield self._nominal(self._phi.toward(state, tool, gap, speed, goal.posture, now, stop=stop), phase)

    def joints(self, goal: Array, phase: str, share: float, speed: float) -> Part:
        """Move in joint space to `goal` (n,) [rad] at `share` of the velocity limits, the tool up to `speed`."""
        progress = Progress(self.senses.patience, limit=30.0)
        while True:
            state, now = self.senses.state, self.senses.now
            error = float(np.max(np.abs(goal - state.q)))
            if error < 0.01:
                return None
            if why := progress.stuck(self.senses.patience, error):
                return Ending(Status.TAKEN_OVER, f"{phase}: {why}, {error:.2f} rad from the goal")
            yield self._nominal(self._phi.toward_joints(state, self.senses.tool, goal, share, speed, now), phase)

    def stay(self, phase: str, duration: float) -> Part:
        """Rest for `duration` [s]."""
        end = self.senses.now + duration
        while self.senses.now < end:
            yield self.rest(phase)
        return None

    def close(self, force: float) -> Part:
        """Close the fingers at `force` [N] until both press and stand still; fails if nothing is between them."""
        self.opening, self.force = 0.0, force
        start = steady = self.senses.now
        before = self.senses.state.opening
        while self.senses.now - start < 2.0:
            state, now = self.senses.state, self.senses.now
            if not self.grips() or abs(state.opening - before) > 2e-4:
                steady, before = now, state.opening
            if now - steady > SETTLED:
                return None
            yield self.rest("close")
        return Ending(Status.FAILED, "close: the two-finger test felt nothing between the fingers")

    def open(self, opening: float) -> Part:
        """Open the fingers to `opening` per finger [m] and let go of what was held."""
        self.opening, self.holding = opening, None
        self.force = self.body.gripper.force_min.value
        start = self.senses.now
        while self.senses.now - start < 1.0 and abs(self.senses.state.opening - opening) > 2e-3:
            yield self.rest("open")
        yield from self.stay("open", 0.2)
        return None

    def step_aside(self, phase: str, height: float) -> Part:
        """Rise until tool and load are above `height` [m], then rest until whoever comes has passed; then `YIELDED`.

        The contacts of `phase` stay allowed: a hand may be leaving a thing it has around it. It takes one tick at
        least, so that who begins again after it does so at another time.
        """
        start, spot = self.senses.now, self.senses.tool.position.copy()
        rotation, posture = self.senses.tool.rotation.copy(), self.senses.state.q.copy()
        while self.senses.now == start or self.threatened(spot, horizon=2.5, reach=BESIDE, ever=True) is not None:
            tool, state, now = self.senses.tool, self.senses.state, self.senses.now
            if now - start > PERSON_PATIENCE:
                return Ending(Status.FAILED, f"{phase}: a person stayed in the way for {PERSON_PATIENCE:.0f} s")
            wanted = min(height + self.below_tool, CEILING)
            if tool.position[2] < wanted - 0.005:
                up = np.array([tool.position[0], tool.position[1], wanted])
                u = self._phi.toward(state, tool, gap_to(tool, up, rotation), YIELD_SPEED, posture, now)
            else:
                u = self._phi.rest(state, now)
            yield self._nominal(u, "yield", permits_of=phase)
        return YIELDED

    # --- facts --------------------------------------------------------------------------------------------------

    def grips(self) -> bool:
        """Whether both fingers press on something (two-finger test)."""
        return min(self.senses.state.finger_forces) >= GRIP_FORCE_MIN

    def goal(self, position: Array, rotations: list[Array]) -> Thought[Goal | None]:
        """The most comfortable way to put the tool at `position` with one of `rotations`; None when out of reach."""
        best = yield from self.kinematics.best(position, rotations, self.senses.state.q)
        return None if best is None else Goal(position, *best)

    def air(
        self, start: Array | None, points: Sequence[Goal], phase: str, opening: float | None = None, *,
        beat: float = -np.inf,
    ) -> Thought[float]:  # fmt: skip
        """Least room [m] to anything perceived, beyond the errors, on the way from posture `start` through `points`.

        From where the arm is when `start` is None; then what is near it now does not count, nor do contacts that
        `phase` needs. Each finger is opened by `opening` [m], or as it is. What is not above `beat` may be too much.
        """
        fingers = self.senses.state.opening if opening is None else opening
        held = self.holding.name if self.holding else None
        view = View(fingers, self.senses.scene, held, self._known, self._touches.get(phase, ()))
        q, leaving = (self.senses.state.q, LEAVING) if start is None else (start, 0)
        return self._foresight.room(q, points, view, leaving=leaving, beat=beat)

    def shifted(self, goal: Goal, position: Array) -> Thought[Goal]:
        """`goal` moved to another position with the same rotation, its posture solved anew where possible."""
        there = yield from self.reachable(goal, position)
        return there or replace(goal, position=position)

    def reachable(self, goal: Goal, position: Array) -> Thought[Goal | None]:
        """`goal` moved to another position with the same rotation; None when it is out of reach there."""
        q = yield from self.kinematics.solve(position, goal.rotation, (goal.posture,), steps=BRIEF)
        return None if q is None else Goal(position, goal.rotation, q)

    def here(self) -> Goal:
        """Where the tool is now, as a goal."""
        tool = self.senses.tool
        return Goal(tool.position.copy(), tool.rotation.copy(), self.senses.state.q.copy())

    def take_hold(self, thing: SceneObject) -> None:
        """Remember that `thing` is between the fingers, and how far its lowest point lies under the tool."""
        self.holding = Holding(thing.name, float(self.senses.tool.position[2]) - self.foot(thing))

    def foot(self, thing: SceneObject) -> float:
        """Height [m] of the lowest point of `thing`: the floor's own, where the eyes' error cannot tell them apart."""
        low = bottom(thing)
        return self.floor if abs(low - self.floor) <= thing.error else low

    def catch(self, name: str) -> bool:
        """Take hold of `name` if nothing is held and both fingers press: they were stopped while closing on it."""
        thing = next((thing for thing in self.senses.scene.objects if thing.name == name), None)
        if thing is None or self.holding or not self.grips():
            return False
        self.take_hold(thing)
        return True

    @property
    def below_tool(self) -> float:
        """How far the lowest point of the load, or of the empty fingers, lies below the tool [m]."""
        return self.holding.below_tool if self.holding else self.body.gripper.pad_below_tool

    def threatened(
        self, spot: Array, horizon: float = 1.5, reach: float = BESIDE, *, ever: bool = False
    ) -> float | None:
        """Height [m] to get above because a person soon sweeps by `spot`; looked at afresh with each new scene.

        With `ever` the height of the tool does not count: whether anyone passes there at all.
        """
        scene, now = self.senses.scene, self.senses.now
        if not any(thing.role == "person" for thing in scene.objects):
            return None
        key = (scene.stamp, horizon, reach, ever)
        if key != self._looked_at:
            lowest = -1.0 if ever else float(self.senses.tool.position[2]) - self.below_tool
            self._looked_at, self._threat = key, threat(scene, spot, lowest, horizon, reach, now)
        return self._threat

    def _distance(self, goal: Goal) -> float:
        away = goal.position - self.senses.tool.position
        return sqrt(float(away @ away))

    def reconsider(self, u: Array) -> Array:
        """u_nom (n,) [rad/s] once more, because what φ knows changed since this tick's was made."""
        return self._phi.reconsider(self.senses.state, u, self.senses.now)

    def rest(self, phase: str) -> Nominal:
        """One tick of standing still."""
        return self._nominal(self._phi.rest(self.senses.state, self.senses.now), phase)

    def _nominal(self, u: Array, phase: str, permits_of: str = "") -> Nominal:
        touches = self._touches.get(permits_of or phase, ())
        return Nominal(u, self.opening, self.force, phase, touches, self.holding)


def lifted(goal: Goal, height: float) -> Goal:
    """`goal` raised to tool height `height` [m]."""
    return replace(goal, position=np.array([goal.position[0], goal.position[1], height]))
