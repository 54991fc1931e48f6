"""The control loop: each tick reads sensors, filters the nominal control, writes it, and lets one period pass.

One tick: supervisor decision → skill's nominal control φ(c, x) → filter → write → record → advance → sense. Every
hazard becomes a condition, and the supervisor decides how the robot reacts to it, in lockstep and in real time alike.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from math import inf
from typing import Protocol

import msgspec

from dualbrain.control.margin_causes import MarginMonitor
from dualbrain.control.obstacle_estimates import INTRODUCTION_RATE, ObstacleEstimates, with_acceleration
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.residual_contacts import ResidualContacts
from dualbrain.control.robot_cover import RobotSpheres
from dualbrain.control.scene_monitor import SceneMonitor, effective_stamp
from dualbrain.control.scene_smoothing import SceneSmoother
from dualbrain.grounding.envelope.object_limits import absent_persons_in_words, limits_in_words, with_object_limits
from dualbrain.records import MARGIN_CAUSE_TEXTS, MarginCause, MarginShortfall, ObjectLimits, Scene
from dualbrain.robots.interface import Array, Command, RobotInterface, RobotState
from dualbrain.robots.model import RobotModel
from dualbrain.safety.barriers.traversable_region import traversable_region
from dualbrain.safety.barriers.workspace import plane
from dualbrain.safety.cbf.filter import FilterResult, SafetyFilter
from dualbrain.safety.cbf.grasped_object import cover_with_spheres
from dualbrain.safety.cbf.obstacles import Contact, Obstacle, PersonLimits, check_scene, obstacle_from_checked_object
from dualbrain.safety.supervisor.actions import NO_ACTION, SafetyAction, SupervisorDecision
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.controller import SafetyController
from dualbrain.safety.supervisor.state_monitor import MonitorLimits
from dualbrain.safety.supervisor.timing import SIMULATED, Timing
from dualbrain.skills.registry import make_controller
from dualbrain.skills.skill import HeldObject, Nominal, Observation, PermittedContact

RELEASE_SETTLING_TIME = 0.5
"""Time [s] after a release during which the released object is assumed to fall and roll."""
GROUND_PLANE = plane("the ground", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), parts=("arm", "hand", "fingers", "held"))
"""Obstacle of a mobile manipulator; an arm that is bolted down has its table."""
IDLE_ACTION = -1
"""Action index of ticks outside a contract."""


class WorldInterface(Protocol):
    """The environment of the robot: how it is perceived, and how time passes."""

    def perceive(self) -> Scene:
        """The scene as perceived now."""
        ...

    def advance(self) -> None:
        """Let one control period pass."""
        ...


class ResultObserver(Protocol):
    """Observes the result of every tick; it runs inside the tick and must be fast."""

    def __call__(self, result: FilterResult, action: SafetyAction, *, in_contract: bool) -> None:
        """Receive the result of the filter, the supervisor's action, and whether a contract runs."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class TickSnapshot:
    """One tick as an observer sees it."""

    state: RobotState
    scene: Scene
    nominal: Nominal
    result: FilterResult
    action: int
    skill: str
    decision: SupervisorDecision = NO_ACTION


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlLoopConfig:
    """Settings of a control loop.

    `guard` False writes the nominal control unfiltered (the paper's B1). `perception_period` [s] is the time between
    two perceived scenes, `snapshot_period` [s] that between two snapshots for observers, `settle_time` [s] the time at
    rest after a contract. `timing` holds the limits on delays of the robot's interface. `unrecorded`: the arm may move
    on if its recording cannot be written. `keep_margins`: observations and ends of permits do not make a margin short
    without need (`ObstacleEstimates`, `ResidualContacts.keep_until_clear`); False is for comparisons. `persons`: speed
    limits near persons, `object_limits`: limits of objects by name or category, both from the site file.
    `monitor_limits`: those of the plausibility of joint states, by default `MonitorLimits()`.
    """

    guard: bool = True
    perception_period: float = 0.033
    snapshot_period: float = 0.020
    settle_time: float = 0.6
    timing: Timing = SIMULATED
    unrecorded: bool = False
    keep_margins: bool = True
    persons: PersonLimits | None = None
    object_limits: Mapping[str, ObjectLimits] = field(default_factory=dict[str, ObjectLimits])
    monitor_limits: MonitorLimits | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopObserver:
    """Callbacks of a control loop; none of them can change what the loop does.

    `on_tick` gets a snapshot every `snapshot_period`, `on_phase` the name of a new phase and the objects in it by role,
    `mark_part` the name of the part of a tick that has just ended. `on_result` gets the result and the supervisor's
    action of every tick, and whether a contract runs.
    """

    on_tick: Callable[[TickSnapshot], None] | None = None
    on_phase: Callable[[str, dict[str, str | None]], None] | None = None
    mark_part: Callable[[str], None] = lambda part: None
    on_result: ResultObserver | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopInputs:
    """Inputs of a control loop in addition to the robot and the world.

    `interrupted`: whether a person wants the robot to stop. `external_conditions`: the `Condition` bits that hold
    outside the loop (operator, connections), read once per tick. `clock` [s] is the loop's own, independent of the
    robot's stamps; without a clock the stamp of the newest state is the time.
    """

    interrupted: Callable[[], bool] = lambda: False
    external_conditions: Callable[[], int] = lambda: 0
    clock: Callable[[], float] | None = None


class ControlLoop:
    """Runs the ticks of one robot.

    State: the newest joint state and scene, the phase with its permitted contacts, the grasped object, and the contacts
    that an interrupted skill left.
    """

    def __init__(
        self,
        robot_model: RobotModel,
        robot: RobotInterface,
        world: WorldInterface,
        safety: SafetyFilter,
        log: FlightLog,
        config: ControlLoopConfig = ControlLoopConfig(),
        observer: LoopObserver = LoopObserver(),
        inputs: LoopInputs = LoopInputs(),
    ) -> None:
        """Connect all parts and perceive the scene once; the robot does not move."""
        self.robot_model, self.robot, self.world, self.safety = robot_model, robot, world, safety
        self.log, self.config, self.observer, self.inputs = log, config, observer, inputs
        self._perception_ticks, self._snapshot_ticks = (
            max(1, round(every / robot_model.period)) for every in (config.perception_period, config.snapshot_period)
        )
        self.controller = make_controller(robot_model, safety)
        self._ground_obstacles = (GROUND_PLANE,) if robot_model.is_mobile_manipulator else ()
        self.safety_controller = SafetyController(safety, timing=config.timing, monitor_limits=config.monitor_limits)
        self.margin_monitor = MarginMonitor(safety)
        self.checks_during_contract: set[str] = set()
        self.recording_failure = ""
        self._drive_on, self._continues = True, False
        self._paused_time = 0.0
        self._last_decision = NO_ACTION
        self._roles: dict[str, str | None] = {}
        self._phase, self._skill, self._in_action = "", "", False
        self._contacts: tuple[PermittedContact, ...] = ()
        self._residual_contacts = ResidualContacts(safety)
        self._contact_speed_scale, self._force_is_measured = 1.0, True
        self._site_noted = False
        self._holding: HeldObject | None = None
        self._ticks = 0
        self.state = robot.read()
        self._observation: Observation | None = None
        self._scene_smoother, self._scene_monitor = SceneSmoother(), SceneMonitor()
        self._estimates, self._robot_spheres = ObstacleEstimates(), RobotSpheres(safety)
        self._last_h_min = -inf
        self._released: tuple[str, float] = ("", -RELEASE_SETTLING_TIME)
        self.scene = self._with_limits(self._scene_smoother.update(check_scene(world.perceive())))
        self._scene_monitor.update(self.scene)
        self.update_obstacles()
        self._read_sensors()

    @property
    def now(self) -> float:
        """The loop's time [s]."""
        return self.inputs.clock() if self.inputs.clock else self.state.stamp

    @property
    def phase(self) -> str:
        """The phase of the running or last skill."""
        return self._phase

    @property
    def held_object(self) -> str | None:
        """The name of the object in the gripper, None if the gripper is empty."""
        return self.controller.holding.name if self.controller.holding else None

    # --- for the executor of contracts ---------------------------------------------------------------------------

    def begin_contract(self) -> None:
        """Forget which checks tripped, and which margins were short, during the contract before."""
        self.checks_during_contract.clear()
        self.margin_monitor.clear()
        self._note_site_entries()

    def resume_grasp(self, held: str, opening: float, force: float) -> None:
        """Continue the grip of an earlier run before the first tick: fingers at `opening` [m] with `force` [N].

        The object `held` ("" for none) counts as held only if both fingers press on it.
        """
        if self.controller.resume_grasp(held, opening, force):
            self.log.note(self.state.stamp, "phase", f"{held} is held since the run before")
        elif held:
            self.log.note(self.state.stamp, "fault", f"{held} was held at the end of the run before, and is not now")

    def begin_action(self, skill: str, roles: dict[str, str | None]) -> None:
        """Name the running skill and the objects in it by role."""
        self._skill, self._roles, self._in_action = skill, roles, True

    def end_contract(self, *, succeeded: bool) -> None:
        """Withdraw all contact permits; after a failure, contacts that still exist remain permitted.

        After a success a permit remains only while the margin of its pair would be short without it.
        """
        ending = self._residual_contacts.combine(self._contacts)
        self._residual_contacts.retain(self._phase, () if succeeded else ending, self.state, self.scene, self.now)
        if succeeded and self.config.keep_margins:
            self._residual_contacts.keep_until_intact(ending, self.state, self.scene, self.now, held=self.held_object)
        self._contacts, self._in_action = (), False
        self._update_permits()
        self._register_late_grasp()

    def stop_on_fault(self) -> None:
        """Switch the drive off at once after a programming error."""
        self.robot.stop()
        self._drive_on = False
        self.safety_controller.report(Condition.PROGRAM_ERROR)

    def add_paused_time(self, seconds: float) -> None:
        """Time [s] that does not count for the patience of the running skill."""
        self._paused_time += seconds

    def observation(self) -> Observation:
        """The newest state, scene and tool pose for the running skill; the same object until one of them changes."""
        contact, last = self.safety_controller.contact, self._observation
        force = contact.force if contact is not None else None
        tool = last.tool if last is not None and last.state is self.state else self.safety.tool(self.state.q)
        if (
            last is not None
            and last.state is self.state
            and last.scene is self.scene
            and last.contact_force is force
            and last.paused_time == self._paused_time
        ):
            return last
        self._observation = Observation(
            state=self.state,
            scene=self.scene,
            now=self.state.stamp,
            tool=tool,
            paused_time=self._paused_time,
            contact_force=force,
        )
        return self._observation

    # --- one tick -------------------------------------------------------------------------------------------------

    def hold(self, duration: float, phase: str = "hold") -> None:
        """Hold position for `duration` [s], during planning or to settle; the filter may still give way.

        The contacts of the last phase remain permitted: a hand that was stopped around an object still touches it.
        """
        self._skill = phase
        for _ in range(round(duration / self.robot_model.period)):
            self.rest_tick(phase, IDLE_ACTION)

    def rest_tick(self, phase: str, action: int) -> FilterResult:
        """One tick at rest; contacts that the last phase permitted remain permitted."""
        nominal = self.controller.rest(phase)
        return self.tick(replace(nominal, phase=self._phase or phase, contacts=self._contacts), action)

    def tick(self, nominal: Nominal, action: int) -> FilterResult:
        """One tick with the control `nominal` of the action with index `action`."""
        now = self.now
        decision = self._decide(now)
        if self._changes_phase(nominal) or nominal.holding is not self._holding:
            self._update_phase_and_grasp(nominal)
            nominal = replace(nominal, u=self.controller.reproject(nominal.u))
        self._continue_desired_motion(now)
        if self.safety_controller.retreating:
            nominal = replace(nominal, u=self._retreat_control())
        result = self.safety_controller.control(self.state, nominal.u, now, guard=self.config.guard)
        self._last_h_min = result.h_min
        self._mark_part("filter")
        if self.config.guard and (shortfall := self.margin_monitor.update(now, self.state, result)):
            text = f"h < 0 of {shortfall.pair or 'a pair'}: {MARGIN_CAUSE_TEXTS[shortfall.cause]}"
            self.log.note(now, "margin", text, pair=shortfall.pair, cause=shortfall.cause.value)
        if self.safety_controller.drive_wanted:
            self.robot.write(Command(result.u, nominal.opening, nominal.force))
        self._mark_part("write")
        self._record(now, nominal, result, action, decision)
        self.world.advance()
        self._ticks += 1
        self._read_sensors()
        self._mark_part("sense")
        return result

    def _continue_desired_motion(self, now: float) -> None:
        """Record that the robot executes another command; the filter continues the motion that the robot executes.

        An event reports the first of several such ticks in a row.
        """
        continued = self.safety_controller.continue_desired_motion(self.state)
        if continued is not None:
            u, change = continued
            self.log.call(self.state.stamp, "reset", u_prev=u, u_change=change)
            if not self._continues:
                self.log.note(now, "command_lost", "the robot executes another command than the last one")
        self._continues = continued is not None

    def _retreat_control(self) -> Array:
        """The nominal control that replaces the skill's while the arm yields to a contact force."""
        u = self.safety_controller.yield_to_contact(self.state)
        if u is not None:
            self.log.call(self.state.stamp, "reset", u_prev=u)
        return self.safety_controller.retreat_control()

    def begin(self) -> None:
        """Read the sensors before the first tick; the state of the construction may be too old by then."""
        self._read_sensors()

    def _record(
        self, now: float, nominal: Nominal, result: FilterResult, action: int, decision: SupervisorDecision
    ) -> None:
        """Record the tick, and pass a snapshot to the observer every snapshot period."""
        scale = self.safety_controller.scale_applied
        self.log.extra_rows(now, self.safety.extra_rows)
        self.log.tick(
            now, self.state, nominal.u, result, action, nominal.phase, order=decision.action, scale_applied=scale
        )
        if self.observer.on_result is not None:
            self.observer.on_result(result, decision.action, in_contract=action >= 0)
        self._mark_part("record")
        if self.observer.on_tick and self._ticks % self._snapshot_ticks == 0:
            snapshot = TickSnapshot(
                state=self.state,
                scene=self.scene,
                nominal=nominal,
                result=result,
                action=action,
                skill=self._skill,
                decision=decision,
            )
            self.observer.on_tick(snapshot)
            self._mark_part("show")

    def _mark_part(self, part: str) -> None:
        self.observer.mark_part(part)

    def _decide(self, now: float) -> SupervisorDecision:
        """The supervisor's decision of this tick, reported when it changes; the drive follows it."""
        conditions = self.inputs.external_conditions() | self._recording_conditions()
        self._mark_part("door")
        if self.inputs.interrupted():
            conditions |= Condition.INTERRUPT
        decision = self.safety_controller.decide(self.state, now, conditions)
        if decision is not NO_ACTION:
            self.checks_during_contract.update(self.safety_controller.supervisor.tripped_checks)
        if decision is not self._last_decision:
            self._last_decision = decision
            name = decision.action.name
            text = f"{name}: {decision.check or 'all clear'}"
            cause, check = decision.cause.value, decision.check
            self.log.note(self.state.stamp, "order", text, action=name, cause=cause, check=check)
        if self.safety_controller.drive_wanted != self._drive_on:
            self._switch_drive(on=self.safety_controller.drive_wanted)
        self._mark_part("supervisor")
        return decision

    def _recording_conditions(self) -> int:
        """Report a recording that cannot be written when that begins; the arm stops because of it."""
        failure = self.log.recording_failure
        if failure != self.recording_failure:
            self.recording_failure = failure
            if failure:
                self.log.note(self.state.stamp, "fault", failure)
        return Condition.RECORDING_LOST if failure and not self.config.unrecorded else 0

    def _switch_drive(self, *, on: bool) -> None:
        self._drive_on = on
        (self.robot.enable if on else self.robot.stop)()
        kind, text = ("order", "drive on, at rest") if on else ("fault", "drive off, brakes on")
        self.log.note(self.state.stamp, kind, text)

    def _read_sensors(self) -> None:
        """Read the joint state and, every perception period, the scene; implausible data is reported and not used."""
        state = self.robot.read()
        now = self.inputs.clock() if self.inputs.clock else state.stamp
        if self.safety_controller.accept_state(state, now):
            self.state = state
        self._follow_contact_force()
        if self._ticks % self._perception_ticks == 0:
            self._perceive()
        self.safety_controller.report(self._scene_monitor.age_conditions(self.scene, now))
        self.controller.observe(self.observation())

    def _follow_contact_force(self) -> None:
        """Adapt the speed of permitted contacts to the measured force; report a sensor that delivers nothing, once."""
        contact = self.safety_controller.contact
        if contact is None:
            return
        measured = contact.external_torque.measures(self.state)
        if self._force_is_measured and not measured:
            text = "the robot delivers no force reading, which its model declares: contact forces are not supervised"
            self.log.note(self.state.stamp, "fault", text)
        self._force_is_measured = measured
        if contact.permitted_speed.scale != self._contact_speed_scale:
            self._update_permits()

    def _perceive(self) -> None:
        scene = self.world.perceive()
        if conditions := self._scene_monitor.update(scene):
            self.safety_controller.report(conditions)
            return
        seen = self._with_hidden(scene)
        self.scene = self._with_limits(self._scene_smoother.update(seen, self._moving_objects()))
        self.log.scene(self.scene)
        if self._residual_contacts.update(self.state, self.scene, self.now):
            self._update_permits()
        self._register_late_grasp()
        self.update_obstacles()

    def _with_hidden(self, scene: Scene) -> Scene:
        """`scene` with the objects of the running action that it lacks, as last perceived: the hand may hide them."""
        needed = {*self._roles.values(), self.held_object} if self._in_action else {self.held_object}
        lacking = needed - {obj.name for obj in scene.objects}
        hidden = tuple(obj for obj in self.scene.objects if obj.name in lacking)
        return msgspec.structs.replace(scene, objects=(*scene.objects, *hidden)) if hidden else scene

    def _with_limits(self, scene: Scene) -> Scene:
        return with_object_limits(scene, self.config.object_limits)

    def _note_site_entries(self) -> None:
        """Log once which objects the site limits, and which of its entries match no object and no person."""
        if self._site_noted:
            return
        self._site_noted = True
        texts = (
            *limits_in_words(self.scene, self.config.object_limits),
            *absent_persons_in_words(self.scene, self.config.persons),
        )
        for text in texts:
            self.log.note(self.state.stamp, "site", text)

    def _register_late_grasp(self) -> None:
        """Detect a grasp that completes after the skill was stopped: both fingers press on the object."""
        target = self._residual_contacts.closing_target
        if target and self.controller.detect_grasp(target):
            self.log.note(self.state.stamp, "phase", f"{target} is held after a stop")
            self._residual_contacts.closing_target = ""

    def _moving_objects(self) -> tuple[str, ...]:
        """Names of the objects that move with the hand or were released just now."""
        name, when = self._released
        fallen = (name,) if self.state.stamp - when < RELEASE_SETTLING_TIME else ()
        return (self._holding.name, *fallen) if self._holding else fallen

    def _update_phase_and_grasp(self, nominal: Nominal) -> None:
        """Follow a new phase or a changed grasp: the pairs that the filter keeps apart change with it."""
        if self._changes_phase(nominal):
            self._enter_phase(nominal)
        if nominal.holding is not self._holding:
            self._set_grasped_object(nominal.holding)

    def _changes_phase(self, nominal: Nominal) -> bool:
        """Whether phase or contacts change: a contract may begin in the phase whose permits ended with the last one."""
        return nominal.phase != self._phase or nominal.contacts != self._contacts

    def _enter_phase(self, nominal: Nominal) -> None:
        """Replace the contact permits by those of the new phase; permits of the last one end with hysteresis."""
        if self.config.keep_margins:
            held = nominal.holding.name if nominal.holding else None
            kept = {(one.robot_part, one.obstacle) for one in nominal.contacts}
            ending = [one for one in self._contacts if (one.robot_part, one.obstacle) not in kept]
            self._residual_contacts.keep_until_intact(ending, self.state, self.scene, self.now, held=held)
        self._phase, self._contacts = nominal.phase, nominal.contacts
        self._update_permits()
        self.log.note(self.state.stamp, "phase", f"{self._skill}: {nominal.phase}")
        if self.observer.on_phase:
            held, left = nominal.holding.name if nominal.holding else None, self._residual_contacts.object_in_fingers
            self.observer.on_phase(nominal.phase, {**self._roles, "held": held, "left": left})

    def _update_permits(self) -> None:
        """Permit the contacts of the phase and the residual ones, slower the larger the measured contact force is."""
        permitted = self._residual_contacts.combine(self._contacts)
        scale = 1.0
        if (contact := self.safety_controller.contact) is not None:
            contact.set_permits(max((one.speed for one in permitted), default=None))
            scale = self._contact_speed_scale = contact.permitted_speed.scale
        contacts = [Contact(one.robot_part, one.obstacle, scale * one.speed) for one in permitted]
        self.log.call(self.state.stamp, "permit", permits=contacts)
        self.safety.permit(contacts)

    def _set_grasped_object(self, holding: HeldObject | None) -> None:
        """Attach the grasped object to the robot at the pose perceived at the grasp, or detach it."""
        if self._holding and holding is None:
            self._released = (self._holding.name, self.state.stamp)
        self._holding = holding
        if self.safety_controller.contact is not None:
            self.safety_controller.contact.set_holding(holding is not None, self.state.stamp)
        if holding is None:
            self.log.call(self.state.stamp, "detach")
            self.safety.detach()
        else:
            obj, tool = self.scene.find(holding.name), self.safety.tool(self.state.q)
            spheres = cover_with_spheres(obj, tool.position, tool.rotation)
            self.log.call(self.state.stamp, "attach", spheres=spheres, error=obj.error)
            self.safety.attach(spheres, obj.error)
        self.update_obstacles(grasped=holding is not None)

    def update_obstacles(self, *, grasped: bool = False) -> None:
        """Report the perceived scene to the filter; the objects of the running action are known to the controller φ.

        `grasped`: an object has just become part of the robot.
        """
        held = self._holding.name if self._holding else None
        supports = {obj.name for obj in self.scene.objects if obj.role == "support"}
        known = (
            supports
            | {name for name in self._roles.values() if name}
            | self._residual_contacts.object_names
            | self._mapped_obstacles()
        )
        obstacles = tuple(
            obstacle_from_checked_object(obj, self.scene.stamp, known=obj.name in known, persons=self.config.persons)
            for obj in self.scene.objects
            if obj.name != held
        )
        stamp = effective_stamp(self.scene)
        if self.config.keep_margins:
            obstacles = self._estimate(obstacles, grasped=grasped)
        if self.scene.region:
            obstacles = (*obstacles, *traversable_region("the floor", self.scene.region), *self._ground_obstacles)
        self.log.call(self.state.stamp, "observe", obstacles=obstacles, stamp=stamp)
        self.safety.observe(obstacles, stamp)

    def _estimate(self, obstacles: tuple[Obstacle, ...], *, grasped: bool) -> tuple[Obstacle, ...]:
        """The valid estimates of `obstacles` that keep the margins as far as possible."""
        age = self.now - effective_stamp(self.scene)
        estimates = self._estimates.update(
            [with_acceleration(one, self.config.perception_period) for one in obstacles],
            self.scene.stamp,
            moved=self._moving_objects(),
            h_min=self._last_h_min,
            cover=lambda: self._robot_spheres.at(self.state, age),
            grasped=grasped,
        )
        for name, shortage in self._estimates.begun.items():
            self._note_introduction(name, shortage, grasped=grasped)
        return estimates

    def _note_introduction(self, name: str, shortage: float, *, grasped: bool) -> None:
        """Record that the margin of the obstacle `name` is introduced, because it is short by `shortage` [m] now."""
        released = name == self._released[0] and name in self._moving_objects()
        cause = MarginCause.ATTACH_DETACH if grasped or released else MarginCause.PERCEPTION_JUMP
        now, duration = self.now, shortage / INTRODUCTION_RATE
        self.margin_monitor.add(
            MarginShortfall(
                start=now,
                duration=duration,
                h_min=-shortage,
                pair=repr(name),
                cause=cause,
                change=shortage,
                introduced=True,
            )
        )
        text = f"the margin of {name!r} is introduced within {duration:.2f} s: {MARGIN_CAUSE_TEXTS[cause]}"
        self.log.note(now, "margin", text, pair=name, cause=cause.value, shortage=shortage)

    def _mapped_obstacles(self) -> set[str]:
        """Fixed obstacles of a mobile base's room, which its controller knows."""
        return {obj.name for obj in self.scene.objects if self.robot_model.is_mobile and obj.role == "obstacle"}
