"""Faults: source, kind and moment, with the action of the supervisor that is expected, declared beforehand.

The kinds of faults are those of PX4's `failure` command. A fault begins at its moment and persists until the end of the
episode. It is injected between the control loop and the world or, for a planner or socket, between a commander and the
gatekeeper's server, so that all other code is that of a run without faults.
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

FaultSource = Literal["state", "scene", "clock", "qp", "drive", "planner", "socket", "target"]
FaultKind = Literal["off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent"]
FaultMoment = Literal["closing", "descending", "grasping", "carrying", "lowering", "between write and acknowledgement"]
SOURCES, KINDS, MOMENTS = get_args(FaultSource), get_args(FaultKind), get_args(FaultMoment)
TARGET = "target"
"""Source of the link to a target, on which filter and supervisor run; without a target it does not exist."""
HOST_SOURCES: tuple[str, ...] = tuple(source for source in SOURCES if source != TARGET)

MOMENT_PHASES: dict[str, tuple[str, ...]] = {
    "closing": ("approach", "carry", "drive"),
    "descending": ("descend",),
    "grasping": ("close",),
    "carrying": ("carry",),
    "lowering": ("lower",),
    "between write and acknowledgement": ("approach", "carry", "drive"),
}
"""Phases in which each moment can occur."""
MOBILE_BASE_MOMENTS = ("closing", "between write and acknowledgement")
"""Moments that also occur for a mobile base: at full speed toward a crate or a person."""
MIN_PEAK_SPEED = 0.3
"""Speed of a joint [rad/s] or base [m/s] whose peak triggers "closing" and "between write and acknowledgement"."""

DELAY_TIME = 0.08
"""Delay of a delayed source [s]."""
SLOW_UPDATE_TICKS = 10
"""Ticks between two updates of a slow source."""
STATE_BIAS = 0.05
"""Error of a wrong joint state [rad]; the position error of a wrong scene is twice that [m]."""
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
    **{(TARGET, kind): ESTOP for kind in KINDS},
}
"""The least action of the supervisor that must follow, by source and kind.

The proposals of a planner that fails while its contract runs are refused with a warning, and the contract continues. A
socket that fails disconnects the commander, and the arm holds position. A message to or from a target that is lost or
changed ends its session, and the drive is switched off. NONE: the fault need not be detected, and must be harmless. In
a scene in which nothing moves, an old scene is as good as a new one; in a scene with a person, it must lead to HOLD.
"""
EXPECTED_WITH_PERSON: dict[tuple[str, str], SafetyAction] = {("scene", "off"): HOLD, ("scene", "slow"): SLOW}
"""The expected actions that differ in a scene with a moving person."""


@dataclass(frozen=True, slots=True)
class Fault:
    """A failure of `source` of the given `kind`, from the `moment` on; `seed` determines its randomness."""

    source: str
    kind: str
    moment: str
    seed: int = 0

    def __post_init__(self) -> None:
        """Raise `UnknownNameError` for an unknown source, kind or moment."""
        for what, name, known in (
            ("source of faults", self.source, SOURCES),
            ("kind of fault", self.kind, KINDS),
            ("moment", self.moment, MOMENTS),
        ):
            if name not in known:
                raise UnknownNameError(what, name, known)

    def expected_action(self, *, scene_moves: bool) -> SafetyAction:
        """The least action of the supervisor that must follow; `scene_moves`: a person moves in the scene."""
        key = (self.source, self.kind)
        return EXPECTED_WITH_PERSON.get(key, EXPECTED_ACTIONS[key]) if scene_moves else EXPECTED_ACTIONS[key]


def draw_moment(seed: int) -> str:
    """One of `MOMENTS`, drawn by `seed`."""
    return MOMENTS[int(np.random.default_rng([seed, 5]).integers(len(MOMENTS)))]


class FaultInjector:
    """Triggers a fault at its moment; `triggered_at` is the time of the trigger [s], None before it."""

    def __init__(self, fault: Fault, now: Callable[[], float]) -> None:
        """Start without a fault; `now` returns the true time [s]."""
        self.fault, self.now = fault, now
        self.rng = np.random.default_rng([fault.seed, 7])
        self.triggered_at: float | None = None
        self._phase, self._peak_speed = "", 0.0
        self._condition_since: float | None = None
        self._trigger_delay = float(self.rng.uniform(0.0, 0.1))

    def set_phase(self, name: str) -> None:
        """Follow the phase of the skill."""
        self._phase = name
        self._condition_since, self._peak_speed = None, 0.0

    def update_speed(self, speed: float) -> None:
        """Follow the speed of the arm's fastest joint [rad/s], or of the base [m/s]; may trigger the fault."""
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
        """Whether `source` fails in this tick; an intermittent fault is active in half of the ticks."""
        if self.triggered_at is None or source != self.fault.source:
            return False
        return self.fault.kind != "intermittent" or bool(self.rng.random() < 0.5)


class FaultyRobot:
    """A robot whose joint states or drive fail."""

    def __init__(self, robot: RobotInterface, injector: FaultInjector, robot_model: RobotModel) -> None:
        """Wrap `robot`, whose model is `robot_model`."""
        self._robot, self._injector = robot, injector
        self._period, self._mobile = robot_model.period, robot_model.is_mobile
        self._last = robot.read()
        self._state_history: deque[RobotState] = deque()
        self._commands: deque[tuple[float, Command]] = deque()
        self._last_command: Command | None = None
        self._u = np.zeros(robot_model.n)
        self._count = 0

    def read(self) -> RobotState:
        """The newest joint state, corrupted if the source fails."""
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
        """Write a command, corrupted if the drive fails.

        Faults of the moment "between write and acknowledgement" are triggered here, because the acknowledgement is
        between this write and the next state.
        """
        if self._injector.fault.moment == "between write and acknowledgement":
            self._injector.update_speed(self._speed(self._last))
        self._commands.append((self._injector.now(), command))
        while len(self._commands) > 1 and self._commands[1][0] <= self._injector.now() - DELAY_TIME:
            self._commands.popleft()
        if not self._injector.is_active("drive"):
            self._last_command, self._u = command, command.u
            self._robot.write(command)
        elif (corrupted := self._corrupt_command(command)) is not None:
            self._robot.write(corrupted)

    def _corrupt_command(self, command: Command) -> Command | None:  # noqa: PLR0911  (one return per kind of fault)
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
        """Switch the drive off; this does not depend on the commands and always works."""
        self._robot.stop()

    def enable(self) -> None:
        """Switch the drive on."""
        self._robot.enable()


class FaultyWorld:
    """An environment whose perception fails; if the filter is slow, several periods pass per tick."""

    def __init__(self, world: WorldInterface, injector: FaultInjector) -> None:
        """Wrap `world`."""
        self._world, self._injector = world, injector
        self._last: Scene | None = None
        self._scene_history: deque[Scene] = deque(maxlen=16)
        self._count = 0

    def perceive(self) -> Scene:
        """The perceived scene, corrupted if the source fails."""
        scene = self._world.perceive()
        self._count += 1
        self._scene_history.append(scene)
        fails = self._injector.is_active("scene") and self._last is not None
        self._last = self._corrupt_scene(scene, self._last or scene) if fails else scene
        return self._last

    def _corrupt_scene(self, scene: Scene, last: Scene) -> Scene:
        rng = self._injector.rng
        match self._injector.fault.kind:
            case "off" | "intermittent":
                return last
            case "stuck":
                objects = tuple(msgspec.structs.replace(obj, stamp=scene.stamp) for obj in last.objects)
                return msgspec.structs.replace(last, stamp=scene.stamp, objects=objects)
            case "garbage":
                bad = [float(value) for value in rng.choice([np.nan, np.inf, -1e9, 1e30], 3)]
                return _shift_objects(scene, lambda position: (bad[0], bad[1], position[2] + bad[2]))
            case "wrong":
                bias = 2.0 * STATE_BIAS
                return _shift_objects(scene, lambda position: (position[0] + bias, position[1], position[2]))
            case "slow":
                return scene if self._count % SLOW_UPDATE_TICKS == 0 else last
            case _:
                return self._scene_history[max(0, len(self._scene_history) - 4)]

    def advance(self) -> None:
        """Let one period pass; with a slow filter, the robot repeats its last command for several periods."""
        slow = self._injector.fault.kind == "slow" and self._injector.is_active("qp")
        for _ in range(SLOW_UPDATE_TICKS if slow else 1):
            self._world.advance()


def faulty_clock(clock: Callable[[], float], injector: FaultInjector) -> Callable[[], float]:
    """A clock [s] that fails, around the true `clock`."""
    rng = injector.rng

    def read_clock() -> float:
        true_time = clock()
        if not injector.is_active("clock"):
            return true_time
        triggered_at = injector.triggered_at or true_time
        readings: dict[str, float] = {
            "off": float("nan"),
            "stuck": triggered_at,
            "garbage": float(rng.normal() * 1e6),
            "wrong": true_time + 10.0,
            "slow": triggered_at + 0.5 * (true_time - triggered_at),
            "delayed": true_time - 0.5,
            "intermittent": float("nan"),
        }
        return readings[injector.fault.kind]

    return read_clock


class BrokenFilterError(RuntimeError):
    """Exception of a filter with the fault "off"."""


def inject_filter_fault(safety: SafetyFilter, injector: FaultInjector) -> None:
    """Make the results of `safety` fail, after the checks inside the kernel."""
    filter_control = safety.filter
    history: deque[FilterResult] = deque(maxlen=round(DELAY_TIME / safety.robot_model.period))

    def faulty_filter(state: RobotState, u_nom: Any, now: float) -> FilterResult:
        result = filter_control(state, u_nom, now)
        history.append(result)
        if not injector.is_active("qp"):
            return result
        controls: dict[str, Any] = {
            "stuck": history[0].u,
            "delayed": history[0].u,
            "garbage": np.full_like(result.u, np.nan),
            "intermittent": np.full_like(result.u, np.nan),
            "wrong": result.u * 0.0 + 30.0,
            "slow": result.u,
        }
        if injector.fault.kind == "off":
            raise BrokenFilterError("the filter does not answer")
        if injector.fault.kind == "stuck":
            history.pop()
            history.appendleft(history[0])
        return msgspec.structs.replace(result, u=np.array(controls[injector.fault.kind]))

    safety.filter = faulty_filter


def _shift_objects(scene: Scene, shift: Callable[[tuple[float, float, float]], tuple[float, float, float]]) -> Scene:
    def moved(obj: SceneObject) -> SceneObject:
        return msgspec.structs.replace(obj, pose=Pose(shift(obj.pose.position), obj.pose.quaternion))

    return msgspec.structs.replace(scene, objects=tuple(moved(obj) for obj in scene.objects))
