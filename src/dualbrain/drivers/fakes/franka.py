"""The Franka Control Interface without an arm: the names of `pylibfranka`, and the reflexes that its maker documents.

Of the joint velocity interface: a packet a millisecond; a command outside of a limit of position, velocity,
acceleration or jerk aborts the motion by a reflex with the controller's own flag; the first command continues at the
last commanded velocity, which is zero; a packet that misses is filled in at constant acceleration, and 20 in a row
abort; after a reflex nothing moves before `automatic_error_recovery`, which a pressed user stop refuses. Time passes
only when a state is waited for.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from types import SimpleNamespace
from typing import Any

import numpy as np

from dualbrain.drivers.fakes.arm import Array, FakeArm
from dualbrain.drivers.vendor_limits import FR3, VendorLimits
from dualbrain.robots.model import RobotModel

DT = 1e-3
MAX_MISSED_PACKETS = 20
"""Packets missed in a row that abort a motion."""
ERROR_FLAGS = (
    "joint_position_limits_violation",
    "joint_velocity_violation",
    "joint_reflex",
    "power_limit_violation",
    "self_collision_avoidance_violation",
    "joint_motion_generator_position_limits_violation",
    "joint_motion_generator_velocity_limits_violation",
    "joint_motion_generator_velocity_discontinuity",
    "joint_motion_generator_acceleration_discontinuity",
    "communication_constraints_violation",
)
"""Those of the 41 that a joint velocity can raise."""


class ControlException(RuntimeError):
    """A motion was aborted."""


class CommandException(RuntimeError):
    """A command was refused."""


class NetworkException(RuntimeError):
    """Nobody answers."""


class InvalidOperationException(RuntimeError):
    """Two motions at once."""


class RobotMode(Enum):
    """What the controller is doing."""

    Idle = 1
    Move = 2
    Reflex = 4
    UserStopped = 5


class Errors:
    """Flags of the controller as attributes; true if any is raised."""

    def __init__(self, *raised: str) -> None:
        """`raised` are names of `FLAGS`."""
        for name in ERROR_FLAGS:
            setattr(self, name, name in raised)
        self._raised = raised

    def __bool__(self) -> bool:
        """Whether any flag is raised."""
        return bool(self._raised)

    def __str__(self) -> str:
        """As the library prints them."""
        return "[" + ", ".join(f'"{name}"' for name in self._raised) + "]"


class Duration:
    """A time of the controller."""

    def __init__(self, seconds: float) -> None:
        """`seconds` [s]."""
        self._seconds = seconds

    def to_sec(self) -> float:
        """In seconds."""
        return self._seconds


class JointVelocities:
    """A command: dq (7,) [rad/s]."""

    def __init__(self, dq: list[float]) -> None:
        """Seven numbers."""
        if len(dq) != 7:
            raise TypeError("incompatible constructor arguments: FixedSize(7)")
        self.dq = [float(value) for value in dq]
        self.motion_finished = False


class FakeFrankaController:
    """The arm's own controller: checks every command, integrates it, and gives up when it has to."""

    def __init__(
        self, robot_model: RobotModel, limits: VendorLimits = FR3, pace: Callable[[float], None] | None = None
    ) -> None:
        """At rest in the body's home, unlocked, FCI active."""
        if limits.acceleration is None or limits.jerk is None:
            raise TypeError("a Franka arm has limits of acceleration and jerk")
        self.arm, self.limits = FakeArm(robot_model.home, float(limits.acceleration.min()), pace), limits
        self._max_acceleration, self._max_jerk = limits.acceleration, limits.jerk
        self.mode, self.errors = RobotMode.Idle, Errors()
        self.missed_in_a_row, self.missed_total = 0, 0
        self.user_stop_pressed = False
        self._n = robot_model.n
        self._begin()

    def _begin(self) -> None:
        self._u, self._acceleration = np.zeros(self._n), np.zeros(self._n)
        self._next: Array | None = None
        self.missed_in_a_row = 0

    def start(self) -> None:
        """Begin a motion."""
        if self.user_stop_pressed or self.mode is RobotMode.UserStopped:
            raise CommandException("libfranka: Move command rejected: command not possible in the current mode!")
        if self.errors:
            raise CommandException(f"libfranka: Move command rejected: {self.errors}")
        if self.mode is RobotMode.Move:
            raise InvalidOperationException("libfranka robot: Cannot perform this operation while another is running")
        self._begin()
        self.mode = RobotMode.Move

    def command(self, u: Array) -> None:
        """A packet came: it is the velocity of the next millisecond."""
        self._next = u

    def halt(self) -> None:
        """The motion is over; the arm brakes."""
        if self.mode is RobotMode.Move:
            self.mode = RobotMode.Idle

    def press_user_stop(self) -> None:
        """A person presses the user stop."""
        self.user_stop_pressed, self.mode = True, RobotMode.UserStopped

    def release_user_stop(self) -> None:
        """And lets it go."""
        self.user_stop_pressed, self.mode = False, RobotMode.Idle

    def collide(self) -> None:
        """Something is hit: the torque threshold of a joint is exceeded."""
        self._reflex("joint_reflex")

    def recover(self) -> None:
        """Clear a reflex."""
        if self.user_stop_pressed:
            raise CommandException("libfranka: AutomaticErrorRecovery command rejected: user stop pressed!")
        self.mode, self.errors = RobotMode.Idle, Errors()

    def step(self) -> None:
        """One millisecond."""
        if self.mode is not RobotMode.Move:
            self.arm.follow(None, DT)
            return
        u = self._next_velocity()
        if flag := self._violated_flag(u):
            self._reflex(flag)
            self.arm.follow(None, DT)
            return
        self._acceleration, self._u = (u - self._u) / DT, u
        self.arm.follow(u, DT)

    def _next_velocity(self) -> Array:
        """The command for this millisecond, or what constant acceleration makes of the last ones."""
        u, self._next = self._next, None
        if u is not None:
            self.missed_in_a_row = 0
            return u
        self.missed_in_a_row += 1
        self.missed_total += 1
        return self._u + self._acceleration * DT

    def _violated_flag(self, u: Array) -> str:
        """The flag that a command raises; "" for none. The necessary conditions of the interface, each strict."""
        if self.missed_in_a_row >= MAX_MISSED_PACKETS:
            return "communication_constraints_violation"
        least, most = self.limits.velocity_limits(self.arm.q)
        acceleration = (u - self._u) / DT
        jerk = (acceleration - self._acceleration) / DT
        low, high = self.limits.position_range.T
        if ((self.arm.q <= low) | (self.arm.q >= high)).any():
            return "joint_motion_generator_position_limits_violation"
        if ((u <= least) | (u >= most)).any() or not np.isfinite(u).all():
            return "joint_motion_generator_velocity_limits_violation"
        if (np.abs(acceleration) > self._max_acceleration * (1.0 + 1e-9)).any():
            return "joint_motion_generator_velocity_discontinuity"
        if (np.abs(jerk) > self._max_jerk * (1.0 + 1e-9)).any():
            return "joint_motion_generator_acceleration_discontinuity"
        return ""

    def _reflex(self, flag: str) -> None:
        self.mode, self.errors = RobotMode.Reflex, Errors(flag)


class FakeFranka:
    """Stands where the module `pylibfranka` would; `controller` is what the test may press, hit and ask."""

    ControlException, CommandException = ControlException, CommandException
    NetworkException, InvalidOperationException = NetworkException, InvalidOperationException
    FrankaException = type("FrankaException", (Exception,), {})
    RealtimeException = type("RealtimeException", (RuntimeError,), {})
    RobotMode, Errors, Duration, JointVelocities = RobotMode, Errors, Duration, JointVelocities
    ControllerMode = SimpleNamespace(JointImpedance=0, CartesianImpedance=1)
    RealtimeConfig = SimpleNamespace(kEnforce=0, kIgnore=1)

    def __init__(self, robot_model: RobotModel, pace: Callable[[float], None] | None = None) -> None:
        """An arm of that body."""
        self.controller = FakeFrankaController(robot_model, pace=pace)
        self.hand = FakeHand(self.controller)
        self.unplugged = False

    def Robot(self, robot_ip_address: str, realtime_config: int = 0) -> Robot:
        """Connect."""
        del robot_ip_address, realtime_config
        return Robot(self)

    def Gripper(self, franka_address: str) -> FakeHand:
        """Connect to the hand."""
        del franka_address
        return self.hand


class Robot:
    """`pylibfranka.Robot`, as far as joint velocities need it."""

    def __init__(self, sdk: FakeFranka) -> None:
        """Connected to `sdk`."""
        self._sdk, self._controller = sdk, sdk.controller

    def read_once(self) -> Any:
        """Wait for the next state; not while a motion is under way."""
        if self._controller.mode is RobotMode.Move:
            raise InvalidOperationException("libfranka robot: Cannot perform this operation while another is running")
        return _next_state(self._sdk)

    def start_joint_velocity_control(self, arg0: int) -> ActiveControlBase:
        """Begin a motion."""
        del arg0
        self._controller.start()
        return ActiveControlBase(self._sdk)

    def automatic_error_recovery(self) -> None:
        """Clear a reflex."""
        self._controller.recover()

    def stop(self) -> None:
        """Stop the motion under way."""
        self._controller.halt()


class ActiveControlBase:
    """A motion under way."""

    def __init__(self, sdk: FakeFranka) -> None:
        """Of `sdk`'s arm."""
        self._sdk, self._controller = sdk, sdk.controller

    def readOnce(self) -> tuple[Any, Duration]:
        """Wait for the next state; raises when the motion was aborted."""
        self._check()
        state = _next_state(self._sdk)
        self._check()
        return state, Duration(DT)

    def writeOnce(self, arg0: JointVelocities) -> None:
        """Send the next command."""
        self._check()
        self._controller.command(np.array(arg0.dq))

    def _check(self) -> None:
        match self._controller.mode:
            case RobotMode.Reflex:
                raise ControlException(
                    f"libfranka: Move command aborted: motion aborted by reflex! {self._controller.errors}"
                )
            case RobotMode.UserStopped:
                raise ControlException("libfranka: Move command aborted: User Stop pressed!")
            case RobotMode.Idle:
                raise ControlException("libfranka: Move command preempted!")
            case RobotMode.Move:
                pass


def _next_state(sdk: FakeFranka) -> Any:
    if sdk.unplugged:
        raise NetworkException("libfranka: UDP receive: Timeout")
    controller = sdk.controller
    controller.step()
    arm = controller.arm
    return SimpleNamespace(
        q=arm.q.tolist(),
        dq=arm.v.tolist(),
        time=Duration(arm.now),
        robot_mode=controller.mode,
        current_errors=controller.errors,
        last_motion_errors=controller.errors,
    )


class FakeHand:
    """`pylibfranka.Gripper`: the fingers arrive at once; `thing` is how wide [m] what lies between them is."""

    def __init__(self, controller: FakeFrankaController) -> None:
        """Open."""
        self._controller = controller
        self._width, self._held = 0.08, False
        self.object_width = 0.0
        self.calls: list[tuple[str, float, float]] = []

    def read_once(self) -> Any:
        """The state of the fingers."""
        return SimpleNamespace(width=self._width, is_grasped=self._held, max_width=0.08, time=Duration(0.0))

    def move(self, arg0: float, arg1: float) -> bool:
        """To a width [m] at a speed [m/s], or as far as the thing lets them."""
        self.calls.append(("move", arg0, arg1))
        self._width, self._held = max(arg0, self.object_width), False
        return True

    def grasp(
        self, width: float, speed: float, force: float, epsilon_inner: float = 0.005, epsilon_outer: float = 0.005
    ) -> bool:
        """Close with a force [N]; held if the width where they stop is within the two tolerances of `width`."""
        self.calls.append(("grasp", width, force))
        del speed
        self._width = max(width, self.object_width)
        self._held = self.object_width > width and width - epsilon_inner < self._width < width + epsilon_outer
        return self._held
