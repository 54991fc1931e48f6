"""Fault injection: what breaks, how, and at which moment; with the order that is expected, declared beforehand.

The vocabulary of kinds is PX4's (`failure` command). A fault strikes once its moment has come and stays until the end.
It is put between the local layer and the world, or (planner, socket) between a commander and the gatekeeper's door,
so that everything else is the code that runs without faults.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import msgspec
import numpy as np

from dualbrain.control.control_loop import WorldInterface
from dualbrain.core.geometry.shapes import Pose
from dualbrain.errors import UnknownNameError
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.interface import Command, RobotInterface, RobotState
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.filter import FilterResult, SafetyFilter
from dualbrain.safety.supervisor.actions import SafetyAction

FaultSource = Literal["state", "scene", "clock", "qp", "drive", "planner", "socket"]
FaultKind = Literal["off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent"]
FaultMoment = Literal["closing", "descending", "grasping", "carrying", "lowering", "between write and acknowledgement"]
SOURCES, KINDS, MOMENTS = get_args(FaultSource), get_args(FaultKind), get_args(FaultMoment)

MOMENT_PHASES: dict[str, tuple[str, ...]] = {
    "closing": ("approach", "carry", "drive"),
    "descending": ("descend",),
    "grasping": ("close",),
    "carrying": ("carry",),
    "lowering": ("lower",),
    "between write and acknowledgement": ("approach", "carry", "drive"),
}
"""The phases in which a moment can come."""
MOBILE_BASE_MOMENTS = ("closing", "between write and acknowledgement")
"""The moments that a base has, too: at full speed toward a crate or a person."""
MIN_PEAK_SPEED = 0.3
"""Closing, and a lost acknowledgement, strike when a joint or base faster than this (SI) has passed its peak."""

DELAY_TIME = 0.08
"""How late what is delayed comes [s]."""
SLOW_UPDATE_TICKS = 10
"""A slow source gives something new once in so many ticks."""
STATE_BIAS = 0.05
"""How wrong a wrong joint state is [rad]; a wrong scene is off by twice that [m]."""
DRIVE_TIME_CONSTANT = 0.4
"""Time constant of a slow drive [s]."""

STOP, HOLD, SLOW, WARN, NONE, ESTOP = (
    SafetyAction.CONTROLLED_STOP,
    SafetyAction.HOLD,
    SafetyAction.SLOW,
    SafetyAction.WARN,
    SafetyAction.NONE,
    SafetyAction.ESTOP,
)
EXPECTED_ACTIONS: dict[tuple[str, str], SafetyAction] = {
    ("state", "off"): STOP,
    ("state", "stuck"): STOP,
    ("state", "garbage"): STOP,
    ("state", "wrong"): STOP,
    ("state", "slow"): WARN,
    ("state", "delayed"): STOP,
    ("state", "intermittent"): WARN,
    ("scene", "off"): NONE,
    ("scene", "stuck"): HOLD,
    ("scene", "garbage"): HOLD,
    ("scene", "wrong"): HOLD,
    ("scene", "slow"): NONE,
    ("scene", "delayed"): NONE,
    ("scene", "intermittent"): NONE,
    ("clock", "off"): STOP,
    ("clock", "stuck"): STOP,
    ("clock", "garbage"): STOP,
    ("clock", "wrong"): STOP,
    ("clock", "slow"): STOP,
    ("clock", "delayed"): STOP,
    ("clock", "intermittent"): STOP,
    ("qp", "off"): ESTOP,
    ("qp", "stuck"): STOP,
    ("qp", "garbage"): STOP,
    ("qp", "wrong"): STOP,
    ("qp", "slow"): STOP,
    ("qp", "delayed"): STOP,
    ("qp", "intermittent"): STOP,
    ("drive", "off"): ESTOP,
    ("drive", "stuck"): STOP,
    ("drive", "garbage"): STOP,
    ("drive", "wrong"): STOP,
    ("drive", "slow"): STOP,
    ("drive", "delayed"): NONE,
    ("drive", "intermittent"): NONE,
    ("planner", "off"): NONE,
    ("planner", "stuck"): WARN,
    ("planner", "garbage"): WARN,
    ("planner", "wrong"): WARN,
    ("planner", "slow"): NONE,
    ("planner", "delayed"): WARN,
    ("planner", "intermittent"): WARN,
    ("socket", "off"): HOLD,
    ("socket", "stuck"): HOLD,
    ("socket", "garbage"): HOLD,
    ("socket", "wrong"): HOLD,
    ("socket", "slow"): HOLD,
    ("socket", "delayed"): NONE,
    ("socket", "intermittent"): HOLD,
}
"""The least order that must come, by source and kind. A planner that breaks while its contract runs is refused with a
warning, and the contract goes on; a socket that breaks takes the commander away, and the arm holds.
NONE: the fault may pass unnoticed, and must be harmless. Of a
scene in which nothing moves, old pictures are as good as new; in one with a person they must lead to HOLD."""
EXPECTED_WITH_PERSON: dict[tuple[str, str], SafetyAction] = {("scene", "off"): HOLD, ("scene", "slow"): SLOW}
"""What is expected where something moves."""


@dataclass(frozen=True, slots=True)
class Fault:
    """`source` fails in the way of `kind`, once the `moment` has come; `seed` for what is random about it."""

    source: str
    kind: str
    moment: str
    seed: int = 0

    def __post_init__(self) -> None:
        """Raise `UnknownName` for words that are not in the vocabulary."""
        for what, word, known in (
            ("source of faults", self.source, SOURCES),
            ("kind of fault", self.kind, KINDS),
            ("moment", self.moment, MOMENTS),
        ):
            if word not in known:
                raise UnknownNameError(what, word, known)

    def expected_action(self, *, scene_moves: bool) -> SafetyAction:
        """The least order that must come."""
        key = (self.source, self.kind)
        return EXPECTED_WITH_PERSON.get(key, EXPECTED_ACTIONS[key]) if scene_moves else EXPECTED_ACTIONS[key]


def draw_moment(seed: int) -> str:
    """One of `MOMENTS`, drawn by `seed`."""
    return MOMENTS[int(np.random.default_rng([seed, 5]).integers(len(MOMENTS)))]


class FaultInjector:
    """Knows whether the moment has come. `struck` [s] is when it did."""

    def __init__(self, fault: Fault, now: Callable[[], float]) -> None:
        """Nothing is broken yet; `now` [s] is true time."""
        self.fault, self.now = fault, now
        self.rng = np.random.default_rng([fault.seed, 7])
        self.triggered_at: float | None = None
        self._phase, self._peak_speed = "", 0.0
        self._condition_since: float | None = None
        self._trigger_delay = float(self.rng.uniform(0.0, 0.1))

    def set_phase(self, name: str) -> None:
        """A phase begins."""
        self._phase = name
        self._condition_since, self._peak_speed = None, 0.0

    def update_speed(self, speed: float) -> None:
        """The arm moves at `speed` [rad/s], its fastest joint; a base drives [m/s]."""
        if self.triggered_at is not None or self._phase not in MOMENT_PHASES[self.fault.moment]:
            return
        self._peak_speed = max(self._peak_speed, speed)
        fast = self.fault.moment in ("closing", "between write and acknowledgement")
        if fast and self._condition_since is None and not MIN_PEAK_SPEED < speed < 0.995 * self._peak_speed:
            return
        self._condition_since = self.now() if self._condition_since is None else self._condition_since
        if self.now() - self._condition_since >= self._trigger_delay:
            self.triggered_at = self.now()

    def is_active(self, source: str) -> bool:
        """Whether `source` is broken in this tick; an intermittent one is so half of the time."""
        if self.triggered_at is None or source != self.fault.source:
            return False
        return self.fault.kind != "intermittent" or bool(self.rng.random() < 0.5)


class FaultyRobot:
    """A robot whose joint states or drive break."""

    def __init__(self, robot: RobotInterface, injector: FaultInjector, robot_model: RobotModel) -> None:
        """Stand before `robot`, which has this `body`."""
        self._robot, self._injector = robot, injector
        self._period, self._mobile = robot_model.period, robot_model.is_mobile
        self._last = robot.read()
        self._state_history: deque[RobotState] = deque()
        self._commands: deque[tuple[float, Command]] = deque()
        self._last_command: Command | None = None
        self._u = np.zeros(robot_model.n)
        self._count = 0

    def read(self) -> RobotState:
        """The newest state, if the source lets it through."""
        injector, state = self._injector, self._robot.read()
        if injector.fault.moment != "between write and acknowledgement":
            injector.update_speed(self._speed(state))
        self._count += 1
        self._state_history.append(state)
        while len(self._state_history) > 1 and self._state_history[1].stamp <= state.stamp - DELAY_TIME:
            self._state_history.popleft()
        self._last = self._corrupt_state(state) if injector.is_active("state") else state
        return self._last

    def _speed(self, state: RobotState) -> float:
        return float(np.abs(state.v[:1] if self._mobile else state.v).max())

    def _corrupt_state(self, state: RobotState) -> RobotState:
        rng = self._injector.rng
        match self._injector.fault.kind:
            case "off" | "intermittent":
                return self._last
            case "stuck":
                return replace(state, q=self._last.q, v=self._last.v)
            case "garbage":
                values = rng.normal(size=len(state.q)) * 10.0 ** rng.uniform(-3.0, 6.0)
                return replace(state, q=values, v=np.where(rng.random(len(values)) < 0.3, np.nan, values))
            case "wrong":
                return replace(state, q=state.q + STATE_BIAS)
            case "slow":
                return state if self._count % SLOW_UPDATE_TICKS == 0 else self._last
            case _:
                return self._state_history[0]

    def write(self, command: Command) -> None:
        """Pass a command on, if the drive does what it is told.

        Between this and the next state lies the acknowledgement: that moment's faults strike here.
        """
        if self._injector.fault.moment == "between write and acknowledgement":
            self._injector.update_speed(self._speed(self._last))
        self._commands.append((self._injector.now(), command))
        while len(self._commands) > 1 and self._commands[1][0] <= self._injector.now() - DELAY_TIME:
            self._commands.popleft()
        if not self._injector.is_active("drive"):
            self._last_command, self._u = command, command.u
            self._robot.write(command)
        elif (other := self._corrupt_command(command)) is not None:
            self._robot.write(other)

    def _corrupt_command(self, command: Command) -> Command | None:  # noqa: PLR0911  (one way of failing each)
        rng = self._injector.rng
        match self._injector.fault.kind:
            case "off":
                self._robot.stop()
                return None
            case "stuck":
                return self._last_command
            case "garbage":
                return replace(command, u=self._u + rng.normal(size=len(command.u)) * 0.3)
            case "wrong":
                return replace(command, u=-command.u)
            case "slow":
                self._u = self._u + (command.u - self._u) * (self._period / DRIVE_TIME_CONSTANT)
                return replace(command, u=self._u)
            case "delayed":
                return self._commands[0][1]
            case _:
                return None

    def stop(self) -> None:
        """Switching off is wired apart from the commands: it always works."""
        self._robot.stop()

    def enable(self) -> None:
        """Drive on."""
        self._robot.enable()


class FaultyWorld:
    """Surroundings whose camera breaks; time goes on as it does, longer where the filter is slow."""

    def __init__(self, world: WorldInterface, injector: FaultInjector) -> None:
        """Stand before `world`."""
        self._world, self._injector = world, injector
        self._last: Scene | None = None
        self._scene_history: deque[Scene] = deque(maxlen=16)
        self._count = 0

    def perceive(self) -> Scene:
        """The scene, if the source lets it through."""
        scene = self._world.perceive()
        self._count += 1
        self._scene_history.append(scene)
        broken = self._injector.is_active("scene") and self._last is not None
        self._last = self._corrupt_scene(scene, self._last or scene) if broken else scene
        return self._last

    def _corrupt_scene(self, scene: Scene, last: Scene) -> Scene:
        rng = self._injector.rng
        match self._injector.fault.kind:
            case "off" | "intermittent":
                return last
            case "stuck":
                things = tuple(msgspec.structs.replace(thing, stamp=scene.stamp) for thing in last.objects)
                return msgspec.structs.replace(last, stamp=scene.stamp, objects=things)
            case "garbage":
                bad = [float(value) for value in rng.choice([np.nan, np.inf, -1e9, 1e30], 3)]
                return _shift_objects(scene, lambda at: (bad[0], bad[1], at[2] + bad[2]))
            case "wrong":
                return _shift_objects(scene, lambda at: (at[0] + 2.0 * STATE_BIAS, at[1], at[2]))
            case "slow":
                return scene if self._count % SLOW_UPDATE_TICKS == 0 else last
            case _:
                return self._scene_history[max(0, len(self._scene_history) - 4)]

    def advance(self) -> None:
        """One period; a slow filter keeps the robot waiting with its last command for several."""
        slow = self._injector.fault.kind == "slow" and self._injector.is_active("qp")
        for _ in range(SLOW_UPDATE_TICKS if slow else 1):
            self._world.advance()


def faulty_clock(clock: Callable[[], float], injector: FaultInjector) -> Callable[[], float]:
    """A clock that breaks."""
    rng = injector.rng

    def broken() -> float:
        true = clock()
        if not injector.is_active("clock"):
            return true
        struck = injector.triggered_at or true
        readings: dict[str, float] = {
            "off": float("nan"),
            "stuck": struck,
            "garbage": float(rng.normal() * 1e6),
            "wrong": true + 10.0,
            "slow": struck + 0.5 * (true - struck),
            "delayed": true - 0.5,
            "intermittent": float("nan"),
        }
        return readings[injector.fault.kind]

    return broken


class BrokenFilterError(RuntimeError):
    """What a filter raises that is gone."""


def inject_filter_fault(safety: SafetyFilter, injector: FaultInjector) -> None:
    """Make the filter's answers break, behind the checks that are inside the kernel itself."""
    usual = safety.filter
    kept: deque[FilterResult] = deque(maxlen=round(DELAY_TIME / safety.robot_model.period))

    def broken(state: RobotState, u_nom: Any, now: float) -> FilterResult:
        result = usual(state, u_nom, now)
        kept.append(result)
        if not injector.is_active("qp"):
            return result
        replaced: dict[str, Any] = {
            "stuck": kept[0].u,
            "delayed": kept[0].u,
            "garbage": np.full_like(result.u, np.nan),
            "intermittent": np.full_like(result.u, np.nan),
            "wrong": result.u * 0.0 + 30.0,
            "slow": result.u,
        }
        if injector.fault.kind == "off":
            raise BrokenFilterError("the filter does not answer")
        if injector.fault.kind == "stuck":
            kept.pop()
            kept.appendleft(kept[0])
        return msgspec.structs.replace(result, u=np.array(replaced[injector.fault.kind]))

    safety.filter = broken


def _shift_objects(scene: Scene, move: Callable[[tuple[float, float, float]], tuple[float, float, float]]) -> Scene:
    def moved(thing: SceneObject) -> SceneObject:
        return msgspec.structs.replace(thing, pose=Pose(move(thing.pose.position), thing.pose.quaternion))

    return msgspec.structs.replace(scene, objects=tuple(moved(thing) for thing in scene.objects))
