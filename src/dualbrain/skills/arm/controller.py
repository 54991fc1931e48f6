"""Arm controller: sub-routines from which the skills of an arm are composed.

A sub-routine yields one `Nominal` per tick (or None while it computes, see `time_slicing`). It returns None on success,
or the `SkillResult` that ends the skill.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from math import inf, sqrt

import numpy as np
from numpy.typing import NDArray

from dualbrain.contracts.skill_spec import SkillSpec
from dualbrain.errors import ConfigurationError
from dualbrain.records import FailureCause, SceneObject
from dualbrain.robots.model import RobotModel
from dualbrain.skills.arm.load_monitor import LoadEvent, LoadMonitor, offset_in_tool, press_on_object
from dualbrain.skills.human_prediction import threat_height
from dualbrain.skills.kinematics.clearance_prediction import (
    IGNORED_START_STEPS,
    ClearancePredictor,
    PredictionContext,
    ToolGoal,
)
from dualbrain.skills.kinematics.inverse_kinematics import MAX_STEPS_PER_CANDIDATE, InverseKinematics
from dualbrain.skills.kinematics.object_geometry import (
    CLEARANCE,
    bottom_height,
    nearest_support,
    part_clearance,
    top_height,
)
from dualbrain.skills.kinematics.resolved_rate import ResolvedRate, pose_error
from dualbrain.skills.progress_watchdog import PROGRESS_TIMEOUT, ProgressWatchdog
from dualbrain.skills.skill import (
    ContactForce,
    HeldObject,
    MotionModel,
    Nominal,
    Observation,
    PermittedContact,
    SkillResult,
    SkillStatus,
)
from dualbrain.skills.time_slicing import SlicedComputation

Array = NDArray[np.float64]
SubRoutine = Generator[Nominal | None, None, SkillResult | None]

GRIP_CONFIRMATION_TIME = 0.15
"""Time [s] for which both fingers must press without interruption to count as a grip; they may still move."""
CLOSING_TIMEOUT = 2.0
"""Time [s] after which fingers that do not both press have nothing between them."""
OPENING_TIMEOUT, PRESSING_TIMEOUT = 1.0, 2.0
"""Time [s] for which fingers may open: while they press on nothing, and while they press on an object."""
RESTING_TOLERANCE, PASSING_TOLERANCE = (0.003, 0.02), (0.02, 0.3)
"""Tolerances of position [m] and rotation [rad] at a goal at which the tool rests, and at one that it passes."""
TOOL_SPEED_FRACTION = 0.95
"""Fraction of the allowed tool speed that φ uses, because posture and rotation control move the tool as well."""
MAX_EVASION_HEIGHT = 0.50
"""Largest tool height during evasion [m]."""
YIELD_SPEED = 0.30
"""Tool speed during evasion of a person [m/s]; less if robot, site or the limit of the held object allows less."""
LEAVING_SPEED, LEAVING_STEP, LEAVING_TIMEOUT = 0.15, 0.05, 2.0
"""Speed of the open hand while it leaves an object [m/s], distance of its goal [m], and longest duration [s]."""
PERSON_CLEARANCE = 0.17
"""Half the width of the hand and a margin [m]: people farther from the tool are no threat."""
YIELDED = SkillResult(SkillStatus.RUNNING, "yielded to a person")
"""Result of a sub-routine that yielded to a person; the path is clear again, and the sub-routine may be repeated."""
PERSON_WAIT_TIMEOUT = 45.0
"""Time [s] for which a skill waits for a person before it fails: people rest beside a place for half a minute."""


class ArmController:
    """Controller of one arm with its gripper. State: the memory of φ, the grip, and the current observation."""

    def __init__(self, robot_model: RobotModel, motion: MotionModel) -> None:
        """Use `motion` for kinematics and projection; call `observe` before every step of a routine."""
        self.robot_model = robot_model
        self.kinematics = InverseKinematics(robot_model, motion)
        self.holding: HeldObject | None = None
        self.opening = robot_model.gripper.opening.value
        self.force = robot_model.gripper.force_min.value
        self.load_event: LoadEvent | None = None
        """The newest change of the load that no skill has reported yet."""
        self.load_monitor = LoadMonitor()
        self._motion = motion
        self._phi = ResolvedRate(robot_model, motion)
        self._clearance_predictor = ClearancePredictor(robot_model, motion)
        self._observation: Observation | None = None
        self._contacts_by_phase: dict[str, tuple[PermittedContact, ...]] = {}
        self._known_objects: tuple[str, ...] = ()
        self._threat_key: tuple[float, float, float, bool] | None = None
        self._threat_height: float | None = None

    # --- observation --------------------------------------------------------------------------------------------

    def observe(self, observation: Observation) -> None:
        """Set the observation of this tick, and follow the load: a lost one is not held any more."""
        self._observation = observation
        if self.holding is None:
            self.load_monitor.forget()
        if event := self.load_monitor.update(observation):
            self.load_event = event
            if event.slip:
                self.record_grasp(self.find_object(event.name))
            else:
                self.holding = None

    def take_load_event(self) -> LoadEvent | None:
        """The newest change of the load, which is then reported."""
        event, self.load_event = self.load_event, None
        return event

    @property
    def observation(self) -> Observation:
        """The observation of this tick; raises `ConfigurationError` before the first call of `observe`."""
        if self._observation is None:
            raise ConfigurationError.stating("ArmController.observe() must be called before the first tick.")
        return self._observation

    def find_object(self, name: str) -> SceneObject:
        """The object `name` as perceived in this tick; raises `UnknownNameError`."""
        return self.observation.scene.find(name)

    def begin(self, spec: SkillSpec, **others: str | None) -> None:
        """Start a skill with its contact permits by phase, for the named target, destination and support."""
        contacts: dict[str, list[PermittedContact]] = {}
        for permit in spec.permits:
            obstacle = others.get(permit.other)
            if obstacle is not None:
                contact = PermittedContact(permit.robot_part, obstacle, permit.speed)
                contacts.setdefault(permit.phase, []).append(contact)
        self._contacts_by_phase = {phase: tuple(pairs) for phase, pairs in contacts.items()}
        self._known_objects = tuple(name for name in others.values() if name)

    @property
    def support(self) -> SceneObject | None:
        """The support surface whose centre is nearest to the arm, if one is perceived."""
        return nearest_support(self.observation.scene, 0.0, 0.0)

    @property
    def support_height(self) -> float:
        """Height of the support surface [m]."""
        return top_height(self.support) if self.support else 0.0

    # --- sub-routines -------------------------------------------------------------------------------------------

    def move_tool(
        self,
        goal: ToolGoal,
        phase: str,
        speed: float,
        *,
        stop: bool = True,
        timeout: float = PROGRESS_TIMEOUT,
        near_suffices: bool = False,
        until: Callable[[], bool] | None = None,
    ) -> SubRoutine:
        """Move the tool to `goal` at up to `speed` [m/s]; with `stop` come to rest there, else pass it.

        If a person is about to pass, the arm evades and the sub-routine ends with `YIELDED`. After `timeout` [s]
        without progress it ends as taken over; with `near_suffices`, which is for goals from which another motion
        follows, it succeeds within `PASSING_TOLERANCE` of the goal. It also succeeds once `until()` is true.
        """
        speed = min(speed, self._max_tool_speed)
        near, turned = RESTING_TOLERANCE if stop else PASSING_TOLERANCE
        progress = ProgressWatchdog(
            self.observation.active_time, time_limit=4.0 + 3.0 * self._distance(goal) / speed, timeout=timeout
        )
        while True:
            tool, state, now = self.observation.tool, self.observation.state, self.observation.now
            gap = pose_error(tool, goal.position, goal.rotation)
            distance, turn = gap.distance, gap.angle
            if (distance < near and turn < turned) or (until is not None and until()):
                return None
            if (height := self.person_threat_height(tool.position)) is not None:
                return (yield from self.avoid_person(phase, height))
            if why := progress.update(self.observation.active_time, distance + 0.1 * turn):
                if near_suffices and distance < PASSING_TOLERANCE[0] and turn < PASSING_TOLERANCE[1]:
                    return None
                return SkillResult(
                    SkillStatus.TAKEN_OVER,
                    f"{phase}: {why}, {distance * 100:.1f} cm from the goal{_describe_turn(turn, turned)}",
                    FailureCause.NO_PROGRESS,
                )
            yield self._nominal(self._phi.toward_pose(state, tool, gap, speed, goal.posture, now, stop=stop), phase)

    def move_joints(self, goal: Array, phase: str, speed_fraction: float, speed: float) -> SubRoutine:
        """Move the joints to `goal` (n,) [rad] at `speed_fraction` of their limits, the tool at up to `speed` [m/s]."""
        progress = ProgressWatchdog(self.observation.active_time, time_limit=30.0)
        while True:
            state, now = self.observation.state, self.observation.now
            error = float(np.max(np.abs(goal - state.q)))
            if error < 0.01:
                return None
            if why := progress.update(self.observation.active_time, error):
                return SkillResult(
                    SkillStatus.TAKEN_OVER, f"{phase}: {why}, {error:.2f} rad from the goal", FailureCause.NO_PROGRESS
                )
            yield self._nominal(
                self._phi.toward_joints(state, self.observation.tool, goal, speed_fraction, speed, now), phase
            )

    def wait(self, phase: str, duration: float) -> SubRoutine:
        """Rest for `duration` [s]; a pause counts, because the fingers follow their command during a pause, too."""
        end = self.observation.now + duration
        while self.observation.now < end:
            yield self.rest(phase)
        return None

    def close_gripper(self, force: float) -> SubRoutine:
        """Close the fingers at `force` [N] until both press on an object; fails if there is nothing between them.

        The opening may still change: an object that is gripped askew turns between the fingers.
        """
        self.opening, self.force = 0.0, force
        start = released = self.observation.active_time
        while self.observation.active_time - start < CLOSING_TIMEOUT:
            now = self.observation.active_time
            if not self.is_gripping():
                released = now
            if now - released > GRIP_CONFIRMATION_TIME:
                return None
            yield self.rest("close")
        return SkillResult(
            SkillStatus.FAILED, "close: the two-finger test felt nothing between the fingers", FailureCause.NOT_GRIPPED
        )

    def open_gripper(self, opening: float, phase: str = "open") -> SubRoutine:
        """Open the fingers to `opening` per finger [m] and release the held object.

        Fails if the fingers still press on an object afterwards; an object that was held is then gripped and held as
        before.
        """
        held, command = self.holding, (self.opening, self.force)
        self.opening, self.holding = opening, None
        self.force = self.robot_model.gripper.force_min.value
        start = self.observation.active_time
        while not self._is_open(opening):
            if self.observation.active_time - start >= (PRESSING_TIMEOUT if self.is_gripping() else OPENING_TIMEOUT):
                break
            yield self.rest(phase)
        yield from self.wait(phase, 0.2)
        why = self.check_release(held.name if held else "")
        if self.holding:
            self.opening, self.force = command
        return why

    def check_release(self, name: str) -> SkillResult | None:
        """None if the fingers press on nothing; else the failure of a release, and `name` ("" for none) is held."""
        if not self.is_gripping():
            return None
        self.detect_grasp(name)
        return SkillResult(
            SkillStatus.FAILED,
            f"open: the hand did not open, the fingers still press on {name or 'an object'}",
            FailureCause.GOAL_MISSED,
        )

    def avoid_person(self, phase: str, height: float) -> SubRoutine:
        """Rise until tool and load are above `height` [m], rest until the person has passed, then return `YIELDED`.

        The phase goes on while the hand is near an object that it may touch, which an empty hand leaves first. The
        contacts of `phase` stay permitted. The sub-routine takes at least one tick, so that a repeated sub-routine
        starts at a later time.
        """
        start, patience = self.observation.now, self.observation.active_time + PERSON_WAIT_TIMEOUT
        spot = self.observation.tool.position.copy()
        rotation, posture = self.observation.tool.rotation.copy(), self.observation.state.q.copy()
        yield from self._leave_objects(phase)
        near = True
        while (
            self.observation.now == start
            or self.person_threat_height(spot, horizon=2.5, radius=PERSON_CLEARANCE, any_height=True) is not None
        ):
            tool, state, now = self.observation.tool, self.observation.state, self.observation.now
            if self.observation.active_time > patience:
                return SkillResult(
                    SkillStatus.FAILED,
                    f"{phase}: a person stayed in the way for {PERSON_WAIT_TIMEOUT:.0f} s",
                    FailureCause.PERSON,
                )
            target_height = min(height + self.below_tool, MAX_EVASION_HEIGHT)
            if tool.position[2] < target_height - 0.005:
                up = np.array([tool.position[0], tool.position[1], target_height])
                u = self._phi.toward_pose(state, tool, pose_error(tool, up, rotation), self._yield_speed, posture, now)
            else:
                u = self._phi.rest(state, now)
            near = near and self._is_near_permitted_contact(phase)
            yield self._nominal(u, phase if near else "yield", contacts_of=phase)
        return YIELDED

    def _leave_objects(self, phase: str) -> Generator[Nominal | None, None, None]:
        """Move the empty hand back along its approach axis, until it is clear of the objects that it may touch."""
        start, first = self.observation.active_time, self.observation.tool
        line, axis, posture = first.position.copy(), first.rotation[:, 2].copy(), self.observation.state.q.copy()
        rotation = first.rotation.copy()
        while (
            self.observation.active_time - start < LEAVING_TIMEOUT
            and not (self.holding or self.is_gripping())
            and self._is_near_permitted_contact(phase)
        ):
            tool, state, now = self.observation.tool, self.observation.state, self.observation.now
            back = line + ((tool.position - line) @ axis - LEAVING_STEP) * axis
            error = pose_error(tool, back, rotation)
            yield self._nominal(self._phi.toward_pose(state, tool, error, LEAVING_SPEED, posture, now), phase)

    def _is_near_permitted_contact(self, phase: str) -> bool:
        """Whether a part of the robot is near an object that it may touch in `phase`, except the held object."""
        held = self.holding.name if self.holding else None
        pairs = [one for one in self._contacts_by_phase.get(phase, ()) if one.obstacle != held]
        if not pairs:
            return False
        centres, radii, groups = self._motion.spheres(self.observation.state.q, self.observation.state.opening)
        perceived = {obj.name: obj for obj in self.observation.scene.objects}
        return any(
            part_clearance(perceived[one.obstacle], one.robot_part, centres, radii, groups) < CLEARANCE
            for one in pairs
            if one.obstacle in perceived
        )

    # --- state and prediction -----------------------------------------------------------------------------------

    def is_gripping(self) -> bool:
        """Whether both fingers press on an object (two-finger test), and not on each other."""
        return press_on_object(self.observation.state)

    @property
    def tool_force(self) -> ContactForce | None:
        """The contact force of this tick if it acts at the tool; None without such an estimate."""
        estimate = self.observation.contact_force
        return estimate if estimate is not None and estimate.place == "tool" else None

    def find_goal(self, position: Array, rotations: list[Array]) -> SlicedComputation[ToolGoal | None]:
        """The tool goal at `position` with the rotation of least posture cost, or None if it is out of reach."""
        best = yield from self.kinematics.solve_best(position, rotations, self.observation.state.q)
        return None if best is None else ToolGoal(position, *best)

    def predict_clearance(
        self,
        start: Array | None,
        waypoints: Sequence[ToolGoal],
        phase: str,
        opening: float | None = None,
        *,
        threshold: float = -np.inf,
    ) -> SlicedComputation[float]:
        """Least clearance [m] beyond the errors to perceived objects, from posture `start` through `waypoints`.

        If `start` is None, the motion begins at the current posture; objects that are close there are ignored at first.
        Contacts of `phase` do not count. Each finger is opened by `opening` [m], by default as it is. The prediction
        may stop early when the clearance is at most `threshold`.
        """
        fingers = self.observation.state.opening if opening is None else opening
        held = self.holding.name if self.holding else None
        view = PredictionContext(
            opening=fingers,
            scene=self.observation.scene,
            held=held,
            known=self._known_objects,
            contacts=self._contacts_by_phase.get(phase, ()),
        )
        q, leaving = (self.observation.state.q, IGNORED_START_STEPS) if start is None else (start, 0)
        return self._clearance_predictor.min_clearance(q, waypoints, view, ignored_steps=leaving, threshold=threshold)

    def translate_goal(self, goal: ToolGoal, position: Array) -> SlicedComputation[ToolGoal]:
        """`goal` moved to another position with the same rotation, with a new posture if it is within reach."""
        there = yield from self.translate_goal_if_reachable(goal, position)
        return there or replace(goal, position=position)

    def translate_goal_if_reachable(self, goal: ToolGoal, position: Array) -> SlicedComputation[ToolGoal | None]:
        """`goal` moved to another position with the same rotation, or None if it is out of reach."""
        q = yield from self.kinematics.solve(position, goal.rotation, (goal.posture,), steps=MAX_STEPS_PER_CANDIDATE)
        return None if q is None else ToolGoal(position, goal.rotation, q)

    def current_goal(self) -> ToolGoal:
        """The current pose of the tool, as a goal."""
        tool = self.observation.tool
        return ToolGoal(tool.position.copy(), tool.rotation.copy(), self.observation.state.q.copy())

    def record_grasp(self, obj: SceneObject) -> None:
        """Store that `obj` is between the fingers, with the distance of its lowest point below the tool."""
        self.holding = HeldObject(obj.name, float(self.observation.tool.position[2]) - self.lowest_point(obj))

    def lowest_point(self, obj: SceneObject) -> float:
        """Height [m] of the lowest point of `obj`; the support height if the difference is within the error."""
        low = bottom_height(obj)
        return self.support_height if abs(low - self.support_height) <= obj.error else low

    def detect_grasp(self, name: str) -> bool:
        """Store `name` as held if nothing is held and both fingers press, as after an interrupted grasp."""
        obj = self._find_if_perceived(name)
        if obj is None or self.holding or not self.is_gripping():
            return False
        self.record_grasp(obj)
        self.watch_load(obj)
        return True

    def _find_if_perceived(self, name: str) -> SceneObject | None:
        return next((obj for obj in self.observation.scene.objects if obj.name == name), None)

    def resume_grasp(self, name: str, opening: float, force: float) -> bool:
        """Continue to grip at `opening` [m] with `force` [N], and store `name` as held if both fingers press on it."""
        self.opening, self.force = opening, force
        return self.detect_grasp(name)

    def check_holding(self) -> None:
        """Monitor a held object that is not monitored yet; it is not held if the fingers do not press on it.

        A grasp that ends during the micro-lift leaves such an object.
        """
        if self.holding is None or self.load_monitor.name == self.holding.name:
            return
        obj = self._find_if_perceived(self.holding.name)
        if obj is not None and self.is_gripping():
            self.watch_load(obj)
        else:
            self.holding = None

    def watch_load(self, obj: SceneObject, offset: Array | None = None) -> None:
        """Monitor the held `obj` until it is released; `offset` (3,) [m] in the tool frame, by default as perceived."""
        tool = self.observation.tool
        here = offset_in_tool(obj, tool.position, tool.rotation) if offset is None else offset
        self.load_monitor.watch(obj, here, self.observation)

    @property
    def below_tool(self) -> float:
        """Distance of the lowest point of the load, or of the empty fingers, below the tool [m]."""
        return self.holding.below_tool if self.holding else self.robot_model.gripper.pad_below_tool

    @property
    def _max_tool_speed(self) -> float:
        """Largest tool speed [m/s] of a nominal motion of φ."""
        return TOOL_SPEED_FRACTION * self.robot_model.tool_speed.value

    @property
    def _yield_speed(self) -> float:
        """Tool speed [m/s] during evasion of a person, within the limit of the held object."""
        most = self.holding.speed_limit(self.observation.scene) if self.holding else inf
        return min(YIELD_SPEED, self._max_tool_speed, most)

    def person_threat_height(
        self, spot: Array, horizon: float = 1.5, radius: float = PERSON_CLEARANCE, *, any_height: bool = False
    ) -> float | None:
        """Height [m] to rise above because a person soon passes `spot`, or None; computed once per scene.

        With `any_height` the height of the tool does not count, only whether a person passes.
        """
        scene, now = self.observation.scene, self.observation.now
        if not any(obj.role == "person" for obj in scene.objects):
            return None
        key = (scene.stamp, horizon, radius, any_height)
        if key != self._threat_key:
            lowest = -1.0 if any_height else float(self.observation.tool.position[2]) - self.below_tool
            self._threat_key, self._threat_height = key, threat_height(scene, spot, lowest, horizon, radius, now)
        return self._threat_height

    def _is_open(self, opening: float) -> bool:
        """Whether the fingers have reached `opening` [m]; never without a measurement."""
        measured = self.observation.state.opening
        return measured is not None and abs(measured - opening) <= 2e-3

    def _distance(self, goal: ToolGoal) -> float:
        away = goal.position - self.observation.tool.position
        return sqrt(float(away @ away))

    def reproject(self, u: Array) -> Array:
        """u_nom (n,) [rad/s] projected again, because the rows known to φ changed within this tick."""
        return self._phi.reproject(self.observation.state, u, self.observation.now)

    def rest(self, phase: str) -> Nominal:
        """One tick without motion."""
        return self._nominal(self._phi.rest(self.observation.state, self.observation.now), phase)

    def _nominal(self, u: Array, phase: str, contacts_of: str = "") -> Nominal:
        contacts = self._contacts_by_phase.get(contacts_of or phase, ())
        return Nominal(
            u=u, opening=self.opening, force=self.force, phase=phase, contacts=contacts, holding=self.holding
        )


def goal_at_height(goal: ToolGoal, height: float) -> ToolGoal:
    """`goal` raised to tool height `height` [m]."""
    return replace(goal, position=np.array([goal.position[0], goal.position[1], height]))


def _describe_turn(turn: float, tolerance: float) -> str:
    """The angle `turn` [rad] to the rotation of a goal in words; "" within the `tolerance` [rad]."""
    return f" and turned by {np.rad2deg(turn):.0f}°" if turn >= tolerance else ""
