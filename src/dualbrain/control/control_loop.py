"""The control tick: what is sensed becomes a filtered control, and time goes on by a period.

One tick: order → skill's nominal control φ(c, x) → filter → write → log → advance → sense. Whatever is wrong becomes a
condition, and the supervisor's order decides what is done about it, the same in lockstep and in real time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.residual_contacts import Leftover
from dualbrain.control.scene_monitor import SceneWatch, believed
from dualbrain.control.scene_smoothing import Steady
from dualbrain.records import Scene
from dualbrain.robots.interface import Command, Robot, RobotState
from dualbrain.robots.model import Body
from dualbrain.safety.barriers.traversable_region import traversable
from dualbrain.safety.barriers.workspace import plane
from dualbrain.safety.cbf.filter import Filtered, SafetyFilter
from dualbrain.safety.cbf.grasped_object import cover
from dualbrain.safety.cbf.obstacles import Contact, from_scene
from dualbrain.safety.supervisor.actions import FREE, Order
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.controller import Spine
from dualbrain.safety.supervisor.timing import SIMULATED, Timing
from dualbrain.skills.registry import limb_of
from dualbrain.skills.skill import Holding, Nominal, Senses, Touch

LET_GO = 0.5
"""For this long after it was let go a thing is believed to fall and roll [s]."""
GROUND = plane("the ground", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), parts=("arm", "hand", "fingers", "held"))
"""What an arm on a base is kept above; a bolted arm has its table."""
IDLE = -1
"""Action index of ticks outside a contract."""


class Surroundings(Protocol):
    """The world beyond the robot: how it is perceived and how time passes."""

    def look(self) -> Scene:
        """The scene as perceived now."""
        ...

    def advance(self) -> None:
        """Let one control period pass."""
        ...


@dataclass(frozen=True, slots=True)
class Moment:
    """What an onlooker may see of a tick."""

    state: RobotState
    scene: Scene
    nominal: Nominal
    result: Filtered
    action: int
    skill: str
    order: Order = FREE


@dataclass(frozen=True, slots=True)
class LayerConfig:
    """`guard` False writes the nominal control unfiltered (the paper's B1).

    A look comes every `look_every` [s], onlookers see a moment every `watch_every` [s]; a contract ends with `settle`
    [s] of rest.
    """

    guard: bool = True
    look_every: float = 0.033
    watch_every: float = 0.020
    settle: float = 0.6


class ControlTick:
    """Owns the tick: senses, what the filter is told of them, the order, the control, the log.

    State: the newest joint state and scene, the phase with its permits, what the hand holds, what was left over.
    """

    def __init__(
        self, body: Body, robot: Robot, surroundings: Surroundings, safety: SafetyFilter, log: FlightLog,
        config: LayerConfig, *, watch: Callable[[Moment], None] | None = None,
        phase_changed: Callable[[str, dict[str, str | None]], None] | None = None,
        interrupted: Callable[[], bool] = lambda: False, clock: Callable[[], float] | None = None,
        asked: Callable[[], int] = lambda: 0, timing: Timing = SIMULATED,
        lap: Callable[[str], None] = lambda part: None,
    ) -> None:  # fmt: skip
        """Bind everything and look around once; the robot is not moved. `interrupted`: a person wants it to stop.

        `asked` gives the `Condition` bits that hold outside (operator, link), once a tick. `clock` [s] is the layer's
        own, independent of the robot's stamps; without one, the newest state's stamp is the time. `lap` hears what part
        of a tick has just been done.
        """
        self.body, self.robot, self.surroundings, self.safety = body, robot, surroundings, safety
        self.log, self.config = log, config
        self._look_ticks, self._watch_ticks = (
            max(1, round(every / body.period)) for every in (config.look_every, config.watch_every)
        )
        self.limb = limb_of(body, safety)
        self._ground = (GROUND,) if body.carries_arm else ()
        self.interrupted, self._asked, self._clock, self._lap = interrupted, asked, clock, lap
        self.spine = Spine(safety, timing=timing)
        self._on = True
        self._attended: set[str] = set()
        self._waited = 0.0
        self._said = FREE
        self._watch = watch
        self._phase_changed = phase_changed
        self._roles: dict[str, str | None] = {}
        self._phase = ""
        self._touches: tuple[Touch, ...] = ()
        self._leftover = Leftover(safety)
        self._holding: Holding | None = None
        self._ticks = 0
        self._skill = ""
        self.state = robot.read()
        self._tool_at, self._tool = self.state, safety.tool(self.state.q)
        self._steady, self._eye = Steady(), SceneWatch()
        self._answer: Filtered | None = None
        self._let_go: tuple[str, float] = ("", -LET_GO)
        self.scene = self._steady.update(surroundings.look())
        self._eye.update(self.scene)
        self._observe()
        self._sense()

    # --- one tick -----------------------------------------------------------------------------------------------

    def hold(self, duration: float, phase: str = "hold") -> None:
        """Stand still for `duration` [s] (while the planner thinks, or to settle); the filter may still yield.

        Contacts that the last phase allowed stay allowed: a hand that was stopped around a thing is still around it.
        """
        self._skill = phase
        for _ in range(round(duration / self.body.period)):
            self._rest(phase, IDLE)

    @property
    def now(self) -> float:
        """The layer's own time [s]."""
        return self._clock() if self._clock else self.state.stamp

    def _rest(self, phase: str, action: int) -> Filtered:
        """One tick of standing still; contacts that the last phase allowed stay allowed."""
        nominal = self.limb.rest(phase)
        return self._tick(replace(nominal, phase=self._phase or phase, touches=self._touches), action)

    def _tick(self, nominal: Nominal, action: int) -> Filtered:
        now = self.now
        order = self._judge(now)
        if nominal.phase != self._phase or nominal.holding is not self._holding:
            self._change(nominal)
            nominal = replace(nominal, u=self.limb.reconsider(nominal.u))
        result = self.spine.control(self.state, nominal.u, now, guard=self.config.guard)
        self._lap("filter")
        if self.spine.driving:
            self.robot.write(Command(result.u, nominal.opening, nominal.force))
        self._lap("write")
        self.log.stated(now, self.safety.stated)
        self.log.tick(
            now, self.state, nominal.u, result, action, nominal.phase, order=order.action, touched=self.spine.touched
        )  # fmt: skip
        self._lap("record")
        if self._watch and self._ticks % self._watch_ticks == 0:
            self._watch(Moment(self.state, self.scene, nominal, result, action, self._skill, order))
            self._lap("show")
        self.surroundings.advance()
        self._ticks += 1
        self._sense()
        self._lap("sense")
        return result

    def _judge(self, now: float) -> Order:
        """This tick's order, told when it is another one; the drive follows it."""
        asked = self._asked()
        self._lap("door")
        if self.interrupted():
            asked |= Condition.INTERRUPT
        order = self.spine.judge(self.state, now, asked)
        if order is not self._said:
            self._said = order
            self._attended.add(order.check)
            self.log.note(self.state.stamp, "order", f"{order.action.name}: {order.check or 'all clear'}",
                          action=order.action.name, cause=order.cause.value, check=order.check)  # fmt: skip
        if self.spine.driving != self._on:
            self._on = self.spine.driving
            (self.robot.enable if self._on else self.robot.stop)()
            self.log.note(self.state.stamp, "fault" if not self._on else "order",
                          "drive on, standing" if self._on else "drive off, brakes on")  # fmt: skip
        self._lap("supervisor")
        return order

    def _sense(self) -> None:
        """Take in the newest joint state and, now and then, the scene; what cannot be is flagged and not used."""
        state = self.robot.read()
        now = self._clock() if self._clock else state.stamp
        if self.spine.sensed(state, now):
            self.state = state
        if self._ticks % self._look_ticks == 0:
            self._look()
        self.spine.flag(self._eye.age(self.scene, now))
        self.limb.sense(self._senses())

    def _look(self) -> None:
        seen = self.surroundings.look()
        if wrong := self._eye.update(seen):
            self.spine.flag(wrong)
            return
        self.scene = self._steady.update(seen, self._unsteady())
        self.log.scene(self.scene)
        if self._leftover.update(self.state, self.scene):
            self._permit()
        self._seize()
        self._observe()

    def _seize(self) -> None:
        """Fingers that were stopped while closing hold the thing as soon as both press on it."""
        if self._leftover.closing_on and self.limb.catch(self._leftover.closing_on):
            self.log.note(self.state.stamp, "phase", f"{self._leftover.closing_on} is held after a stop")
            self._leftover.closing_on = ""

    def _senses(self) -> Senses:
        if self._tool_at is not self.state:
            self._tool_at, self._tool = self.state, self.safety.tool(self.state.q)
        return Senses(self.state, self.scene, self.state.stamp, self._tool, self._waited)

    def _unsteady(self) -> tuple[str, ...]:
        """What moves with the hand, or has just left it."""
        name, when = self._let_go
        fallen = (name,) if self.state.stamp - when < LET_GO else ()
        return (self._holding.name, *fallen) if self._holding else fallen

    def _change(self, nominal: Nominal) -> None:
        """A new phase or a changed grip: what the filter keeps apart changes with it."""
        if nominal.phase != self._phase:
            self._enter(nominal)
        if nominal.holding is not self._holding:
            self._take(nominal.holding)

    def _enter(self, nominal: Nominal) -> None:
        """A new phase: its contact permits replace the old ones."""
        self._phase, self._touches = nominal.phase, nominal.touches
        self._permit()
        self.log.note(self.state.stamp, "phase", f"{self._skill}: {nominal.phase}")
        if self._phase_changed:
            self._phase_changed(
                nominal.phase,
                {
                    **self._roles,
                    "held": nominal.holding.name if nominal.holding else None,
                    "left": self._leftover.around,
                },
            )

    def _permit(self) -> None:
        """The contacts of the phase, and those left over."""
        touches = self._leftover.beside(self._touches)
        contacts = [Contact(touch.robot_part, touch.obstacle, touch.speed) for touch in touches]
        self.log.call(self.state.stamp, "permit", permits=contacts)
        self.safety.permit(contacts)

    def _take(self, holding: Holding | None) -> None:
        """Attach what was grasped as part of the body, at the pose perceived at the grasp; or detach it."""
        if self._holding and holding is None:
            self._let_go = (self._holding.name, self.state.stamp)
        self._holding = holding
        if holding is None:
            self.log.call(self.state.stamp, "detach")
            self.safety.detach()
        else:
            thing, tool = self.scene.find(holding.name), self.safety.tool(self.state.q)
            spheres = cover(thing, tool.position, tool.rotation)
            self.log.call(self.state.stamp, "attach", spheres=spheres, error=thing.error)
            self.safety.attach(spheres, thing.error)
        self._observe()

    def _observe(self) -> None:
        """Hand the perceived scene to the filter; what this action is about is known to φ."""
        held = self._holding.name if self._holding else None
        supports = {thing.name for thing in self.scene.objects if thing.role == "support"}
        known = supports | {name for name in self._roles.values() if name} | self._leftover.names | self._on_map()
        obstacles, stamp = from_scene(self.scene, known=known, held=held), believed(self.scene)
        if self.scene.region:
            obstacles = (*obstacles, *traversable("the floor", self.scene.region), *self._ground)
        self.log.call(self.state.stamp, "observe", obstacles=obstacles, stamp=stamp)
        self.safety.observe(obstacles, stamp)

    def _on_map(self) -> set[str]:
        """A base knows its room: what stands there for good is known to φ."""
        return {thing.name for thing in self.scene.objects if self.body.mobile and thing.role == "obstacle"}
