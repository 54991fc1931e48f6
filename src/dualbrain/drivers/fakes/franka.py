"""Fake of the Franka Control Interface: the names of `pylibfranka`, and the documented reflexes of the controller.

Rules of the joint velocity interface: one packet per millisecond; a command outside a limit of position, velocity,
acceleration or jerk aborts the motion by a reflex with the flag of the controller; the first command continues the last
commanded velocity, which is zero; a missed packet is extrapolated at constant acceleration, and 20 missed packets in a
row abort the motion; after a reflex nothing moves before `automatic_error_recovery`, which is refused while the user
stop is pressed. Time advances only when a state is requested.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from enum import Enum
from types import SimpleNamespace
from typing import Any

import numpy as np

from dualbrain.drivers.fakes.arm import Array, FakeArm
from dualbrain.drivers.vendor_limits import FR3, VendorLimits
from dualbrain.robots.model import RobotModel

DT = 1e-3
"""Period of the controller [s]."""
SUCCESS_RATE_WINDOW = 100
"""Number of packets over which the controller computes its success rate."""
MAX_MISSED_PACKETS = 20
"""Number of missed packets in a row that aborts a motion."""
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
"""The error flags, out of 41, that a joint velocity command can raise."""


class ControlException(RuntimeError):
    """A motion was aborted."""


class CommandException(RuntimeError):
    """A command was refused."""


class NetworkException(RuntimeError):
    """The controller does not answer."""


class InvalidOperationException(RuntimeError):
    """Another operation is running."""


class RobotMode(Enum):
    """Mode of the controller."""

    Idle = 1
    Move = 2
    Reflex = 4
    UserStopped = 5


class Errors:
    """Error flags of the controller as attributes; true if any flag is raised."""

    def __init__(self, *raised: str) -> None:
        """Raise the flags called `raised`, which are names in `ERROR_FLAGS`."""
        for name in ERROR_FLAGS:
            setattr(self, name, name in raised)
        self._raised = raised

    def __bool__(self) -> bool:
        """Whether any flag is raised."""
        return bool(self._raised)

    def __str__(self) -> str:
        """The raised flags in the format of the library."""
        return "[" + ", ".join(f'"{name}"' for name in self._raised) + "]"


class Duration:
    """A time of the controller."""

    def __init__(self, seconds: float) -> None:
        """A time of `seconds` [s]."""
        self._seconds = seconds

    def to_sec(self) -> float:
        """The time in seconds."""
        return self._seconds


class JointVelocities:
    """A command with joint velocities dq (7,) [rad/s]."""

    def __init__(self, dq: list[float]) -> None:
        """Command the seven velocities `dq` [rad/s]; raises `TypeError` for another number."""
        if len(dq) != 7:
            raise TypeError("incompatible constructor arguments: FixedSize(7)")
        self.dq = [float(value) for value in dq]
        self.motion_finished = False


class FakeFrankaController:
    """Fake of the arm's controller: checks every command, integrates it, and aborts the motion by a reflex."""

    def __init__(
        self, robot_model: RobotModel, limits: VendorLimits = FR3, pace: Callable[[float], None] | None = None
    ) -> None:
        """The arm is at rest in the home posture of `robot_model`, unlocked, with FCI active."""
        if limits.acceleration is None or limits.jerk is None:
            raise TypeError("a Franka arm has limits of acceleration and jerk")
        self.arm, self.limits = FakeArm(robot_model.home, float(limits.acceleration.min()), pace), limits
        self._max_acceleration, self._max_jerk = limits.acceleration, limits.jerk
        self.mode, self.errors = RobotMode.Idle, Errors()
        self.missed_in_a_row, self.missed_total = 0, 0
        self.received: deque[bool] = deque(maxlen=SUCCESS_RATE_WINDOW)
        """Whether each of the last packets of the motion arrived."""
        self.user_stop_pressed = False
        self._n = robot_model.n
        self._begin()

    def _begin(self) -> None:
        self._u, self._acceleration = np.zeros(self._n), np.zeros(self._n)
        self._next: Array | None = None
        self.missed_in_a_row = 0
        self.received.clear()

    @property
    def desired_v(self) -> Array:
        """The velocity (7,) [rad/s] that is executed, zero without a motion."""
        return self._u if self.mode is RobotMode.Move else np.zeros(self._n)

    @property
    def desired_a(self) -> Array:
        """The acceleration (7,) [rad/s²] that is executed, zero without a motion."""
        return self._acceleration if self.mode is RobotMode.Move else np.zeros(self._n)

    @property
    def success_rate(self) -> float:
        """Share of the last 100 packets that arrived; 0 without a motion."""
        return sum(self.received) / SUCCESS_RATE_WINDOW if self.mode is RobotMode.Move else 0.0

    def start(self) -> None:
        """Start a motion; raises the library's exceptions if that is not possible."""
        if self.user_stop_pressed or self.mode is RobotMode.UserStopped:
            raise CommandException("libfranka: Move command rejected: command not possible in the current mode!")
        if self.errors:
            raise CommandException(f"libfranka: Move command rejected: {self.errors}")
        if self.mode is RobotMode.Move:
            raise InvalidOperationException("libfranka robot: Cannot perform this operation while another is running")
        self._begin()
        self.mode = RobotMode.Move

    def command(self, u: Array) -> None:
        """Receive a packet: the joint velocity (7,) [rad/s] of the next millisecond."""
        self._next = u

    def halt(self) -> None:
        """End the motion; the arm brakes."""
        if self.mode is RobotMode.Move:
            self.mode = RobotMode.Idle

    def press_user_stop(self) -> None:
        """Press the user stop."""
        self.user_stop_pressed, self.mode = True, RobotMode.UserStopped

    def release_user_stop(self) -> None:
        """Release the user stop."""
        self.user_stop_pressed, self.mode = False, RobotMode.Idle

    def collide(self) -> None:
        """Simulate a collision: the torque threshold of a joint is exceeded."""
        self._reflex("joint_reflex")

    def recover(self) -> None:
        """Clear a reflex."""
        if self.user_stop_pressed:
            raise CommandException("libfranka: AutomaticErrorRecovery command rejected: user stop pressed!")
        self.mode, self.errors = RobotMode.Idle, Errors()

    def step(self) -> None:
        """Advance the time by one millisecond."""
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
        """The command for this millisecond; a missing one is extrapolated at constant acceleration."""
        u, self._next = self._next, None
        self.received.append(u is not None)
        if u is not None:
            self.missed_in_a_row = 0
            return u
        self.missed_in_a_row += 1
        self.missed_total += 1
        return self._u + self._acceleration * DT

    def _violated_flag(self, u: Array) -> str:
        """The flag that a command raises by the necessary conditions of the interface; "" for none."""
        if self.missed_in_a_row >= MAX_MISSED_PACKETS:
            return "communication_constraints_violation"
        v_min, v_max = self.limits.velocity_limits(self.arm.q)
        acceleration = (u - self._u) / DT
        jerk = (acceleration - self._acceleration) / DT
        low, high = self.limits.position_range.T
        if ((self.arm.q <= low) | (self.arm.q >= high)).any():
            return "joint_motion_generator_position_limits_violation"
        if ((u <= v_min) | (u >= v_max)).any() or not np.isfinite(u).all():
            return "joint_motion_generator_velocity_limits_violation"
        if (np.abs(acceleration) > self._max_acceleration * (1.0 + 1e-9)).any():
            return "joint_motion_generator_velocity_discontinuity"
        if (np.abs(jerk) > self._max_jerk * (1.0 + 1e-9)).any():
            return "joint_motion_generator_acceleration_discontinuity"
        return ""

    def _reflex(self, flag: str) -> None:
        self.mode, self.errors = RobotMode.Reflex, Errors(flag)


class FakeFranka:
    """Fake of the module `pylibfranka`; tests control and inspect the arm through `controller`."""

    ControlException, CommandException = ControlException, CommandException
    NetworkException, InvalidOperationException = NetworkException, InvalidOperationException
    FrankaException = type("FrankaException", (Exception,), {})
    RealtimeException = type("RealtimeException", (RuntimeError,), {})
    RobotMode, Errors, Duration, JointVelocities = RobotMode, Errors, Duration, JointVelocities
    ControllerMode = SimpleNamespace(JointImpedance=0, CartesianImpedance=1)
    RealtimeConfig = SimpleNamespace(kEnforce=0, kIgnore=1)

    def __init__(self, robot_model: RobotModel, pace: Callable[[float], None] | None = None) -> None:
        """A fake arm with the joints of `robot_model`; `pace(now)` may delay each step."""
        self.controller = FakeFrankaController(robot_model, pace=pace)
        self.hand = FakeHand(self.controller)
        self.unplugged = False

    def Robot(self, robot_ip_address: str, realtime_config: int = 0) -> Robot:
        """Connect to the arm."""
        del robot_ip_address, realtime_config
        return Robot(self)

    def Gripper(self, franka_address: str) -> FakeHand:
        """Connect to the hand."""
        del franka_address
        return self.hand


class Robot:
    """The part of `pylibfranka.Robot` that joint velocities need."""

    def __init__(self, sdk: FakeFranka) -> None:
        """Connected to the arm of `sdk`."""
        self._sdk, self._controller = sdk, sdk.controller

    def read_once(self) -> Any:
        """Wait for the next state; not allowed during a motion."""
        if self._controller.mode is RobotMode.Move:
            raise InvalidOperationException("libfranka robot: Cannot perform this operation while another is running")
        return _next_state(self._sdk)

    def start_joint_velocity_control(self, arg0: int) -> ActiveControlBase:
        """Start a motion."""
        del arg0
        self._controller.start()
        return ActiveControlBase(self._sdk)

    def automatic_error_recovery(self) -> None:
        """Clear a reflex."""
        self._controller.recover()

    def stop(self) -> None:
        """Stop the current motion."""
        self._controller.halt()


class ActiveControlBase:
    """A running motion."""

    def __init__(self, sdk: FakeFranka) -> None:
        """A motion of the arm of `sdk`."""
        self._sdk, self._controller = sdk, sdk.controller

    def readOnce(self) -> tuple[Any, Duration]:
        """Wait for the next state; raises `ControlException` if the motion was aborted."""
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
        dq_d=controller.desired_v.tolist(),
        ddq_d=controller.desired_a.tolist(),
        time=Duration(arm.now),
        robot_mode=controller.mode,
        current_errors=controller.errors,
        last_motion_errors=controller.errors,
        control_command_success_rate=controller.success_rate,
    )


class FakeHand:
    """Fake of `pylibfranka.Gripper`: the fingers move at once; `object_width` [m] is the object between them."""

    def __init__(self, controller: FakeFrankaController) -> None:
        """The hand is open."""
        self._controller = controller
        self._width, self._held = 0.08, False
        self.object_width = 0.0
        self.calls: list[tuple[str, float, float]] = []

    def read_once(self) -> Any:
        """The state of the fingers."""
        return SimpleNamespace(width=self._width, is_grasped=self._held, max_width=0.08, time=Duration(0.0))

    def move(self, arg0: float, arg1: float) -> bool:
        """Move to a width [m] at a speed [m/s]; the fingers stop at the object."""
        self.calls.append(("move", arg0, arg1))
        self._width, self._held = max(arg0, self.object_width), False
        return True

    def grasp(
        self, width: float, speed: float, force: float, epsilon_inner: float = 0.005, epsilon_outer: float = 0.005
    ) -> bool:
        """Close with a force [N]; the object is held if the final width is within both tolerances of `width`."""
        self.calls.append(("grasp", width, force))
        del speed
        self._width = max(width, self.object_width)
        self._held = self.object_width > width and width - epsilon_inner < self._width < width + epsilon_outer
        return self._held
