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

from dualbrain.control.control_loop import Surroundings
from dualbrain.core.geometry.shapes import Pose
from dualbrain.errors import UnknownName
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.interface import Command, Robot, RobotState
from dualbrain.robots.model import Body
from dualbrain.safety.cbf.filter import Filtered, SafetyFilter
from dualbrain.safety.supervisor.actions import Rung

Source = Literal["state", "scene", "clock", "qp", "drive", "planner", "socket"]
Kind = Literal["off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent"]
Moment = Literal["closing", "descending", "grasping", "carrying", "lowering", "between write and acknowledgement"]
SOURCES, KINDS, MOMENTS = get_args(Source), get_args(Kind), get_args(Moment)

PHASES: dict[str, tuple[str, ...]] = {
    "closing": ("approach", "carry", "drive"), "descending": ("descend",), "grasping": ("close",),
    "carrying": ("carry",), "lowering": ("lower",),
    "between write and acknowledgement": ("approach", "carry", "drive"),
}  # fmt: skip
"""The phases in which a moment can come."""
ON_WHEELS = ("closing", "between write and acknowledgement")
"""The moments that a base has, too: at full speed toward a crate or a person."""
FULL_SPEED = 0.3
"""Closing, and a lost acknowledgement, strike when a joint or base faster than this (SI) has passed its peak."""

LATE = 0.08
"""How late what is delayed comes [s]."""
SLOW_EVERY = 10
"""A slow source gives something new once in so many ticks."""
BIAS = 0.05
"""How wrong a wrong joint state is [rad]; a wrong scene is off by twice that [m]."""
LAG = 0.4
"""Time constant of a slow drive [s]."""

STOP, HOLD, SLOW, WARN, NONE, ESTOP = (
    Rung.CONTROLLED_STOP, Rung.HOLD, Rung.SLOW, Rung.WARN, Rung.NONE, Rung.ESTOP,
)  # fmt: skip
EXPECTED: dict[tuple[str, str], Rung] = {
    ("state", "off"): STOP, ("state", "stuck"): STOP, ("state", "garbage"): STOP, ("state", "wrong"): STOP,
    ("state", "slow"): WARN, ("state", "delayed"): STOP, ("state", "intermittent"): WARN,
    ("scene", "off"): NONE, ("scene", "stuck"): HOLD, ("scene", "garbage"): HOLD, ("scene", "wrong"): HOLD,
    ("scene", "slow"): NONE, ("scene", "delayed"): NONE, ("scene", "intermittent"): NONE,
    ("clock", "off"): STOP, ("clock", "stuck"): STOP, ("clock", "garbage"): STOP, ("clock", "wrong"): STOP,
    ("clock", "slow"): STOP, ("clock", "delayed"): STOP, ("clock", "intermittent"): STOP,
    ("qp", "off"): ESTOP, ("qp", "stuck"): STOP, ("qp", "garbage"): STOP, ("qp", "wrong"): STOP,
    ("qp", "slow"): STOP, ("qp", "delayed"): STOP, ("qp", "intermittent"): STOP,
    ("drive", "off"): ESTOP, ("drive", "stuck"): STOP, ("drive", "garbage"): STOP, ("drive", "wrong"): STOP,
    ("drive", "slow"): STOP, ("drive", "delayed"): NONE, ("drive", "intermittent"): NONE,
    ("planner", "off"): NONE, ("planner", "stuck"): WARN, ("planner", "garbage"): WARN, ("planner", "wrong"): WARN,
    ("planner", "slow"): NONE, ("planner", "delayed"): WARN, ("planner", "intermittent"): WARN,
    ("socket", "off"): HOLD, ("socket", "stuck"): HOLD, ("socket", "garbage"): HOLD, ("socket", "wrong"): HOLD,
    ("socket", "slow"): HOLD, ("socket", "delayed"): NONE, ("socket", "intermittent"): HOLD,
}  # fmt: skip
"""The least order that must come, by source and kind. A planner that breaks while its contract runs is refused with a
warning, and the contract goes on; a socket that breaks takes the commander away, and the arm holds.
NONE: the fault may pass unnoticed, and must be harmless. Of a
scene in which nothing moves, old pictures are as good as new; in one with a person they must lead to HOLD."""
WITH_A_PERSON: dict[tuple[str, str], Rung] = {("scene", "off"): HOLD, ("scene", "slow"): SLOW}
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
            ("source of faults", self.source, SOURCES), ("kind of fault", self.kind, KINDS),
            ("moment", self.moment, MOMENTS),
        ):  # fmt: skip
            if word not in known:
                raise UnknownName(what, word, known)

    def expected(self, *, moving: bool) -> Rung:
        """The least order that must come."""
        key = (self.source, self.kind)
        return WITH_A_PERSON.get(key, EXPECTED[key]) if moving else EXPECTED[key]


def drawn_moment(seed: int) -> str:
    """One of `MOMENTS`, drawn by `seed`."""
    return MOMENTS[int(np.random.default_rng([seed, 5]).integers(len(MOMENTS)))]


class Injector:
    """Knows whether the moment has come. `struck` [s] is when it did."""

    def __init__(self, fault: Fault, now: Callable[[], float]) -> None:
        """Nothing is broken yet; `now` [s] is true time."""
        self.fault, self.now = fault, now
        self.rng = np.random.default_rng([fault.seed, 7])
        self.struck: float | None = None
        self._phase, self._fastest = "", 0.0
        self._since: float | None = None
        self._wait = float(self.rng.uniform(0.0, 0.1))

    def phase(self, name: str) -> None:
        """A phase begins."""
        self._phase = name
        self._since, self._fastest = None, 0.0

    def moved(self, speed: float) -> None:
        """The arm moves at `speed` [rad/s], its fastest joint; a base drives [m/s]."""
        if self.struck is not None or self._phase not in PHASES[self.fault.moment]:
            return
        self._fastest = max(self._fastest, speed)
        fast = self.fault.moment in ("closing", "between write and acknowledgement")
        if fast and self._since is None and not FULL_SPEED < speed < 0.995 * self._fastest:
            return
        self._since = self.now() if self._since is None else self._since
        if self.now() - self._since >= self._wait:
            self.struck = self.now()

    def strikes(self, source: str) -> bool:
        """Whether `source` is broken in this tick; an intermittent one is so half of the time."""
        if self.struck is None or source != self.fault.source:
            return False
        return self.fault.kind != "intermittent" or bool(self.rng.random() < 0.5)


class FaultyRobot:
    """A robot whose joint states or drive break."""

    def __init__(self, robot: Robot, injector: Injector, body: Body) -> None:
        """Stand before `robot`, which has this `body`."""
        self._robot, self._injector = robot, injector
        self._period, self._drives = body.period, body.mobile
        self._last = robot.read()
        self._kept: deque[RobotState] = deque()
        self._commands: deque[tuple[float, Command]] = deque()
        self._stuck: Command | None = None
        self._u = np.zeros(body.n)
        self._count = 0

    def read(self) -> RobotState:
        """The newest state, if the source lets it through."""
        injector, state = self._injector, self._robot.read()
        if injector.fault.moment != "between write and acknowledgement":
            injector.moved(self._speed(state))
        self._count += 1
        self._kept.append(state)
        while len(self._kept) > 1 and self._kept[1].stamp <= state.stamp - LATE:
            self._kept.popleft()
        self._last = self._broken(state) if injector.strikes("state") else state
        return self._last

    def _speed(self, state: RobotState) -> float:
        return float(np.abs(state.v[:1] if self._drives else state.v).max())

    def _broken(self, state: RobotState) -> RobotState:
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
                return replace(state, q=state.q + BIAS)
            case "slow":
                return state if self._count % SLOW_EVERY == 0 else self._last
            case _:
                return self._kept[0]

    def write(self, command: Command) -> None:
        """Pass a command on, if the drive does what it is told.

        Between this and the next state lies the acknowledgement: that moment's faults strike here.
        """
        if self._injector.fault.moment == "between write and acknowledgement":
            self._injector.moved(self._speed(self._last))
        self._commands.append((self._injector.now(), command))
        while len(self._commands) > 1 and self._commands[1][0] <= self._injector.now() - LATE:
            self._commands.popleft()
        if not self._injector.strikes("drive"):
            self._stuck, self._u = command, command.u
            self._robot.write(command)
        elif (other := self._disobeyed(command)) is not None:
            self._robot.write(other)

    def _disobeyed(self, command: Command) -> Command | None:  # noqa: PLR0911  (one way of failing each)
        rng = self._injector.rng
        match self._injector.fault.kind:
            case "off":
                self._robot.stop()
                return None
            case "stuck":
                return self._stuck
            case "garbage":
                return replace(command, u=self._u + rng.normal(size=len(command.u)) * 0.3)
            case "wrong":
                return replace(command, u=-command.u)
            case "slow":
                self._u = self._u + (command.u - self._u) * (self._period / LAG)
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

    def __init__(self, world: Surroundings, injector: Injector) -> None:
        """Stand before `world`."""
        self._world, self._injector = world, injector
        self._last: Scene | None = None
        self._kept: deque[Scene] = deque(maxlen=16)
        self._count = 0

    def look(self) -> Scene:
        """The scene, if the source lets it through."""
        scene = self._world.look()
        self._count += 1
        self._kept.append(scene)
        broken = self._injector.strikes("scene") and self._last is not None
        self._last = self._broken(scene, self._last or scene) if broken else scene
        return self._last

    def _broken(self, scene: Scene, last: Scene) -> Scene:
        rng = self._injector.rng
        match self._injector.fault.kind:
            case "off" | "intermittent":
                return last
            case "stuck":
                things = tuple(msgspec.structs.replace(thing, stamp=scene.stamp) for thing in last.objects)
                return msgspec.structs.replace(last, stamp=scene.stamp, objects=things)
            case "garbage":
                bad = [float(value) for value in rng.choice([np.nan, np.inf, -1e9, 1e30], 3)]
                return _shifted(scene, lambda at: (bad[0], bad[1], at[2] + bad[2]))
            case "wrong":
                return _shifted(scene, lambda at: (at[0] + 2.0 * BIAS, at[1], at[2]))
            case "slow":
                return scene if self._count % SLOW_EVERY == 0 else last
            case _:
                return self._kept[max(0, len(self._kept) - 4)]

    def advance(self) -> None:
        """One period; a slow filter keeps the robot waiting with its last command for several."""
        slow = self._injector.fault.kind == "slow" and self._injector.strikes("qp")
        for _ in range(SLOW_EVERY if slow else 1):
            self._world.advance()


def faulty_clock(clock: Callable[[], float], injector: Injector) -> Callable[[], float]:
    """A clock that breaks."""
    rng = injector.rng

    def broken() -> float:
        true = clock()
        if not injector.strikes("clock"):
            return true
        struck = injector.struck or true
        readings: dict[str, float] = {
            "off": float("nan"), "stuck": struck, "garbage": float(rng.normal() * 1e6), "wrong": true + 10.0,
            "slow": struck + 0.5 * (true - struck), "delayed": true - 0.5, "intermittent": float("nan"),
        }  # fmt: skip
        return readings[injector.fault.kind]

    return broken


class BrokenFilterError(RuntimeError):
    """What a filter raises that is gone."""


def break_filter(safety: SafetyFilter, injector: Injector) -> None:
    """Make the filter's answers break, behind the checks that are inside the kernel itself."""
    usual = safety.filter
    kept: deque[Filtered] = deque(maxlen=round(LATE / safety.body.period))

    def broken(state: RobotState, u_nom: Any, now: float) -> Filtered:
        result = usual(state, u_nom, now)
        kept.append(result)
        if not injector.strikes("qp"):
            return result
        replaced: dict[str, Any] = {
            "stuck": kept[0].u, "delayed": kept[0].u, "garbage": np.full_like(result.u, np.nan),
            "intermittent": np.full_like(result.u, np.nan), "wrong": result.u * 0.0 + 30.0, "slow": result.u,
        }  # fmt: skip
        if injector.fault.kind == "off":
            raise BrokenFilterError("the filter does not answer")
        if injector.fault.kind == "stuck":
            kept.pop()
            kept.appendleft(kept[0])
        return msgspec.structs.replace(result, u=np.array(replaced[injector.fault.kind]))

    safety.filter = broken


def _shifted(scene: Scene, move: Callable[[tuple[float, float, float]], tuple[float, float, float]]) -> Scene:
    def moved(thing: SceneObject) -> SceneObject:
        return msgspec.structs.replace(thing, pose=Pose(move(thing.pose.position), thing.pose.quaternion))

    return msgspec.structs.replace(scene, objects=tuple(moved(thing) for thing in scene.objects))
