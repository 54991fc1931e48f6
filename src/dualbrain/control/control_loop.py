"""The control tick: what is sensed becomes a filtered control, and time goes on by a period.

One tick: order → skill's nominal control φ(c, x) → filter → write → log → advance → sense. Whatever is wrong becomes a
condition, and the supervisor's order decides what is done about it, the same in lockstep and in real time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.residual_contacts import ResidualContacts
from dualbrain.control.scene_monitor import SceneMonitor, effective_stamp
from dualbrain.control.scene_smoothing import SceneSmoother
from dualbrain.records import Scene
from dualbrain.robots.interface import Command, RobotInterface, RobotState
from dualbrain.robots.model import RobotModel
from dualbrain.safety.barriers.traversable_region import traversable_region
from dualbrain.safety.barriers.workspace import plane
from dualbrain.safety.cbf.filter import FilterResult, SafetyFilter
from dualbrain.safety.cbf.grasped_object import cover_with_spheres
from dualbrain.safety.cbf.obstacles import Contact, obstacles_from_scene
from dualbrain.safety.supervisor.actions import NO_ACTION, SupervisorDecision
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.controller import SafetyController
from dualbrain.safety.supervisor.timing import SIMULATED, Timing
from dualbrain.skills.registry import make_controller
from dualbrain.skills.skill import HeldObject, Nominal, Observation, PermittedContact

RELEASE_SETTLING_TIME = 0.5
"""For this long after it was let go a thing is believed to fall and roll [s]."""
GROUND_PLANE = plane("the ground", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), parts=("arm", "hand", "fingers", "held"))
"""What an arm on a base is kept above; a bolted arm has its table."""
IDLE_ACTION = -1
"""Action index of ticks outside a contract."""


class WorldInterface(Protocol):
    """The world beyond the robot: how it is perceived and how time passes."""

    def perceive(self) -> Scene:
        """The scene as perceived now."""
        ...

    def advance(self) -> None:
        """Let one control period pass."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class TickSnapshot:
    """What an onlooker may see of a tick."""

    state: RobotState
    scene: Scene
    nominal: Nominal
    result: FilterResult
    action: int
    skill: str
    order: SupervisorDecision = NO_ACTION


@dataclass(frozen=True, slots=True)
class ExecutorConfig:
    """`guard` False writes the nominal control unfiltered (the paper's B1).

    A look comes every `look_every` [s], onlookers see a moment every `watch_every` [s]; a contract ends with `settle`
    [s] of rest.
    """

    guard: bool = True
    perception_period: float = 0.033
    snapshot_period: float = 0.020
    settle_time: float = 0.6


class ControlLoop:
    """Owns the tick: senses, what the filter is told of them, the order, the control, the log.

    State: the newest joint state and scene, the phase with its permits, what the hand holds, what was left over.
    """

    def __init__(
        self,
        robot_model: RobotModel,
        robot: RobotInterface,
        world: WorldInterface,
        safety: SafetyFilter,
        log: FlightLog,
        config: ExecutorConfig,
        *,
        on_tick: Callable[[TickSnapshot], None] | None = None,
        on_phase: Callable[[str, dict[str, str | None]], None] | None = None,
        interrupted: Callable[[], bool] = lambda: False,
        clock: Callable[[], float] | None = None,
        external_conditions: Callable[[], int] = lambda: 0,
        timing: Timing = SIMULATED,
        mark_part: Callable[[str], None] = lambda part: None,
    ) -> None:
        """Bind everything and look around once; the robot is not moved. `interrupted`: a person wants it to stop.

        `asked` gives the `Condition` bits that hold outside (operator, link), once a tick. `clock` [s] is the layer's
        own, independent of the robot's stamps; without one, the newest state's stamp is the time. `lap` hears what part
        of a tick has just been done.
        """
        self.robot_model, self.robot, self.world, self.safety = robot_model, robot, world, safety
        self.log, self.config = log, config
        self._perception_ticks, self._snapshot_ticks = (
            max(1, round(every / robot_model.period)) for every in (config.perception_period, config.snapshot_period)
        )
        self.controller = make_controller(robot_model, safety)
        self._ground_obstacles = (GROUND_PLANE,) if robot_model.is_mobile_manipulator else ()
        self.interrupted, self._external_conditions, self._clock, self._mark_part = (
            interrupted,
            external_conditions,
            clock,
            mark_part,
        )
        self.safety_controller = SafetyController(safety, timing=timing)
        self._drive_on = True
        self._checks_during_contract: set[str] = set()
        self._paused_time = 0.0
        self._last_decision = NO_ACTION
        self._on_tick = on_tick
        self._on_phase = on_phase
        self._roles: dict[str, str | None] = {}
        self._phase = ""
        self._touches: tuple[PermittedContact, ...] = ()
        self._residual_contacts = ResidualContacts(safety)
        self._holding: HeldObject | None = None
        self._ticks = 0
        self._skill = ""
        self.state = robot.read()
        self._tool_state, self._tool = self.state, safety.tool(self.state.q)
        self._scene_smoother, self._scene_monitor = SceneSmoother(), SceneMonitor()
        self._last_result: FilterResult | None = None
        self._released: tuple[str, float] = ("", -RELEASE_SETTLING_TIME)
        self.scene = self._scene_smoother.update(world.perceive())
        self._scene_monitor.update(self.scene)
        self._update_obstacles()
        self._read_sensors()

    # --- one tick -----------------------------------------------------------------------------------------------

    def hold(self, duration: float, phase: str = "hold") -> None:
        """Stand still for `duration` [s] (while the planner thinks, or to settle); the filter may still yield.

        Contacts that the last phase allowed stay allowed: a hand that was stopped around a thing is still around it.
        """
        self._skill = phase
        for _ in range(round(duration / self.robot_model.period)):
            self._rest_tick(phase, IDLE_ACTION)

    @property
    def now(self) -> float:
        """The layer's own time [s]."""
        return self._clock() if self._clock else self.state.stamp

    def _rest_tick(self, phase: str, action: int) -> FilterResult:
        """One tick of standing still; contacts that the last phase allowed stay allowed."""
        nominal = self.controller.rest(phase)
        return self._tick(replace(nominal, phase=self._phase or phase, contacts=self._touches), action)

    def _tick(self, nominal: Nominal, action: int) -> FilterResult:
        now = self.now
        order = self._decide(now)
        if nominal.phase != self._phase or nominal.holding is not self._holding:
            self._update_phase_and_grasp(nominal)
            nominal = replace(nominal, u=self.controller.reproject(nominal.u))
        result = self.safety_controller.control(self.state, nominal.u, now, guard=self.config.guard)
        self._mark_part("filter")
        if self.safety_controller.drive_wanted:
            self.robot.write(Command(result.u, nominal.opening, nominal.force))
        self._mark_part("write")
        self.log.extra_rows(now, self.safety.extra_rows)
        self.log.tick(
            now,
            self.state,
            nominal.u,
            result,
            action,
            nominal.phase,
            order=order.action,
            scale_applied=self.safety_controller.scale_applied,
        )
        self._mark_part("record")
        if self._on_tick and self._ticks % self._snapshot_ticks == 0:
            self._on_tick(
                TickSnapshot(
                    state=self.state,
                    scene=self.scene,
                    nominal=nominal,
                    result=result,
                    action=action,
                    skill=self._skill,
                    order=order,
                )
            )
            self._mark_part("show")
        self.world.advance()
        self._ticks += 1
        self._read_sensors()
        self._mark_part("sense")
        return result

    def _decide(self, now: float) -> SupervisorDecision:
        """This tick's order, told when it is another one; the drive follows it."""
        asked = self._external_conditions()
        self._mark_part("door")
        if self.interrupted():
            asked |= Condition.INTERRUPT
        order = self.safety_controller.decide(self.state, now, asked)
        if order is not self._last_decision:
            self._last_decision = order
            self._checks_during_contract.add(order.check)
            self.log.note(
                self.state.stamp,
                "order",
                f"{order.action.name}: {order.check or 'all clear'}",
                action=order.action.name,
                cause=order.cause.value,
                check=order.check,
            )
        if self.safety_controller.drive_wanted != self._drive_on:
            self._drive_on = self.safety_controller.drive_wanted
            (self.robot.enable if self._drive_on else self.robot.stop)()
            self.log.note(
                self.state.stamp,
                "fault" if not self._drive_on else "order",
                "drive on, standing" if self._drive_on else "drive off, brakes on",
            )
        self._mark_part("supervisor")
        return order

    def _read_sensors(self) -> None:
        """Take in the newest joint state and, now and then, the scene; what cannot be is flagged and not used."""
        state = self.robot.read()
        now = self._clock() if self._clock else state.stamp
        if self.safety_controller.accept_state(state, now):
            self.state = state
        if self._ticks % self._perception_ticks == 0:
            self._perceive()
        self.safety_controller.report(self._scene_monitor.age_conditions(self.scene, now))
        self.controller.observe(self._observation())

    def _perceive(self) -> None:
        seen = self.world.perceive()
        if wrong := self._scene_monitor.update(seen):
            self.safety_controller.report(wrong)
            return
        self.scene = self._scene_smoother.update(seen, self._moving_objects())
        self.log.scene(self.scene)
        if self._residual_contacts.update(self.state, self.scene):
            self._update_permits()
        self._register_late_grasp()
        self._update_obstacles()

    def _register_late_grasp(self) -> None:
        """Fingers that were stopped while closing hold the thing as soon as both press on it."""
        if self._residual_contacts.closing_target and self.controller.detect_grasp(
            self._residual_contacts.closing_target
        ):
            self.log.note(self.state.stamp, "phase", f"{self._residual_contacts.closing_target} is held after a stop")
            self._residual_contacts.closing_target = ""

    def _observation(self) -> Observation:
        if self._tool_state is not self.state:
            self._tool_state, self._tool = self.state, self.safety.tool(self.state.q)
        return Observation(
            state=self.state, scene=self.scene, now=self.state.stamp, tool=self._tool, paused_time=self._paused_time
        )

    def _moving_objects(self) -> tuple[str, ...]:
        """What moves with the hand, or has just left it."""
        name, when = self._released
        fallen = (name,) if self.state.stamp - when < RELEASE_SETTLING_TIME else ()
        return (self._holding.name, *fallen) if self._holding else fallen

    def _update_phase_and_grasp(self, nominal: Nominal) -> None:
        """A new phase or a changed grip: what the filter keeps apart changes with it."""
        if nominal.phase != self._phase:
            self._enter_phase(nominal)
        if nominal.holding is not self._holding:
            self._set_grasped_object(nominal.holding)

    def _enter_phase(self, nominal: Nominal) -> None:
        """A new phase: its contact permits replace the old ones."""
        self._phase, self._touches = nominal.phase, nominal.contacts
        self._update_permits()
        self.log.note(self.state.stamp, "phase", f"{self._skill}: {nominal.phase}")
        if self._on_phase:
            self._on_phase(
                nominal.phase,
                {
                    **self._roles,
                    "held": nominal.holding.name if nominal.holding else None,
                    "left": self._residual_contacts.object_in_fingers,
                },
            )

    def _update_permits(self) -> None:
        """The contacts of the phase, and those left over."""
        touches = self._residual_contacts.combine(self._touches)
        contacts = [Contact(touch.robot_part, touch.obstacle, touch.speed) for touch in touches]
        self.log.call(self.state.stamp, "permit", permits=contacts)
        self.safety.permit(contacts)

    def _set_grasped_object(self, holding: HeldObject | None) -> None:
        """Attach what was grasped as part of the body, at the pose perceived at the grasp; or detach it."""
        if self._holding and holding is None:
            self._released = (self._holding.name, self.state.stamp)
        self._holding = holding
        if holding is None:
            self.log.call(self.state.stamp, "detach")
            self.safety.detach()
        else:
            thing, tool = self.scene.find(holding.name), self.safety.tool(self.state.q)
            spheres = cover_with_spheres(thing, tool.position, tool.rotation)
            self.log.call(self.state.stamp, "attach", spheres=spheres, error=thing.error)
            self.safety.attach(spheres, thing.error)
        self._update_obstacles()

    def _update_obstacles(self) -> None:
        """Hand the perceived scene to the filter; what this action is about is known to φ."""
        held = self._holding.name if self._holding else None
        supports = {thing.name for thing in self.scene.objects if thing.role == "support"}
        known = (
            supports
            | {name for name in self._roles.values() if name}
            | self._residual_contacts.object_names
            | self._mapped_obstacles()
        )
        obstacles, stamp = obstacles_from_scene(self.scene, known=known, held=held), effective_stamp(self.scene)
        if self.scene.region:
            obstacles = (*obstacles, *traversable_region("the floor", self.scene.region), *self._ground_obstacles)
        self.log.call(self.state.stamp, "observe", obstacles=obstacles, stamp=stamp)
        self.safety.observe(obstacles, stamp)

    def _mapped_obstacles(self) -> set[str]:
        """A base knows its room: what stands there for good is known to φ."""
        return {thing.name for thing in self.scene.objects if self.robot_model.is_mobile and thing.role == "obstacle"}
