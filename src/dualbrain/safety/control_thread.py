"""Control thread: supervisor and safety filter of one arm in a C thread, without the interpreter in the loop.

Python supplies nominal controls and scenes and reads the log. A late or missing input is a condition of the
supervisor: without a new nominal control for `control_valid` the arm holds (check `heartbeat_lost`), and an old scene
slows it and then stops it. Every tick decides as `SafetyController`: equal inputs give equal decisions and equal bits
of the control.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Sequence
from math import inf, nan
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dualbrain.core.geometry import validation
from dualbrain.errors import ConfigurationError, DualbrainError
from dualbrain.robots.interface import RobotState
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.kernel import select_build
from dualbrain.safety.supervisor.conditions import BUTTONS, Condition
from dualbrain.safety.supervisor.enforcement import StandstillLimits
from dualbrain.safety.supervisor.state_monitor import RANGE_TOLERANCE, MonitorLimits
from dualbrain.safety.supervisor.timing import SIMULATED, Timing

Array = NDArray[np.float64]

MAX_PRIORITY = 99
_MEMORY_LOCKS: tuple[str, ...] = ("none", "loop", "process")
_NO_STATE_OPENING = nan
_MAX_SEQUENCE = 2**64 - 1


class ControlThreadError(DualbrainError):
    """The control thread cannot be started, or is used in a wrong order."""


class ControlThreadConfig(msgspec.Struct, frozen=True, kw_only=True):
    """Settings of the thread.

    - `control_valid` [s]: time for which a nominal control stays in force.
    - `priority`: of SCHED_FIFO, 1 to 99; 0: ordinary scheduling.
    - `lock_process`: lock all memory of the process, not only that of the loop.
    - `forces_supervised`: the program that supplies the nominal controls supervises contact forces. Without it a robot
      with force sensing is refused, because this thread does not.
    - `caller_lost_after` [s]: if a call of `read_log` is followed by no other within this time, the program above
      the thread hangs: the arm is stopped and its drive switched off (check `tick_lost`). The time begins with the
      first plausible state. By default the arm holds without limit.
    """

    control_valid: float = 0.05
    priority: int = 80
    lock_process: bool = False
    forces_supervised: bool = False
    caller_lost_after: float = inf


class ControlThreadStatus(msgspec.Struct, frozen=True, kw_only=True):
    """State of the thread.

    `real_time`: it has SCHED_FIFO. `memory_lock` is "none", "loop" or "process". `late` ticks began more than
    0.2 ms after their time, `skipped` periods had none; `max_late` and `max_work` in s. `log_dropped` records did not
    fit into the log, and `refused` nominal controls were not finite. `last_tick` [s] is by CLOCK_MONOTONIC. On a link,
    `malformed` packets of the robot were dropped, and `unsent` commands were lost.
    """

    running: bool
    finished: bool
    real_time: bool
    memory_lock: str
    late: int
    skipped: int
    max_late: float
    max_work: float
    log_dropped: int
    refused: int
    malformed: int
    unsent: int
    last_tick: float
    warnings: tuple[str, ...]


class ControlThread:
    """Runs filter and supervisor of one arm in C, against a simulated arm, a robot process, or a driver in Python.

    Use it as a context manager, or call `stop`; a thread that is forgotten stops when its object is deleted. All
    methods are for one thread of Python at a time.
    """

    def __init__(
        self,
        safety: SafetyFilter,
        config: ControlThreadConfig | None = None,
        *,
        timing: Timing = SIMULATED,
        monitor_limits: MonitorLimits | None = None,
        standstill_limits: StandstillLimits | None = None,
        simulated_at: ArrayLike | None = None,
        link: socket.socket | None = None,
    ) -> None:
        """Copy the robot and the configuration of `safety`; its current scene is submitted.

        With `simulated_at` (n,) [rad] a simulated arm that rests in this posture is the robot. With `link`, a connected
        socket of packets (`dbk_packet_driver.h`), it is the process at the other end, whose states pace the ticks; the
        thread owns the socket. Otherwise `push_state` and `pop_commands` are the link to the robot.

        Raises:
            ConfigurationError: the base is mobile, there are Python barriers, the robot has force sensing without
                `forces_supervised`, or a value of `config` is out of range.
        """
        self.safety, self.config = safety, config or ControlThreadConfig()
        self.timing = timing
        _check_config(self.config)
        robot_model = safety.robot_model
        if robot_model.force_sensing and not self.config.forces_supervised:
            raise ConfigurationError.stating(
                f"The control thread does not supervise contact forces, and {robot_model.name} has force sensing.",
                fix="Use SafetyController, or set `forces_supervised` if your program or another device limits them.",
            )
        kernel, _ = safety.kernel_scene()
        limits = loop_limits(safety, self.config, timing, monitor_limits or MonitorLimits(), standstill_limits)
        self._period_us = round(limits["period"] * 1e6)
        build: Any = select_build(robot_model, safety.config)
        self._link = link
        descriptor = -1 if link is None else link.fileno()
        self._loop = build.ControlLoop(kernel, limits, simulated_arm(safety, simulated_at), descriptor)
        fields, size = build.ControlLoop.record_layout()
        self._record_type = _record_type(fields, size)
        self._controls = self._scenes = 0
        self._started = False
        self.submit_scene()

    # --- inputs -----------------------------------------------------------------------------------------------

    def submit_control(self, u_nom: ArrayLike, *, standstill: bool = False) -> bool:
        """Replace the nominal control (n,) [rad/s]; False if it is refused because a value is not finite.

        `standstill`: the arm is at rest and stays there; the filter does not move it, not even away from obstacles.
        """
        u = np.ascontiguousarray(validation.as_real_array("u_nom", u_nom, (self.safety.robot_model.n,)), float)
        self._controls += 1
        return self._loop.submit_control(u, standstill, self._controls)

    def submit_scene(self) -> int:
        """Replace the scene by the one that `safety` has now; returns its number in the log."""
        kernel, stamp = self.safety.kernel_scene()
        self._scenes += 1
        self._loop.submit_scene(kernel, stamp, self._scenes)
        return self._scenes

    def push_state(self, state: RobotState) -> bool:
        """Pass a joint state of the robot to the loop; False if its ring is full. Stamps are by CLOCK_MONOTONIC.

        A state that lacks a value, or has a stamp that is no time, stops the arm (check `state_implausible`).
        """
        opening = _NO_STATE_OPENING if state.opening is None else state.opening
        motion = [state.q, state.v]
        if state.desired_v is not None and state.desired_a is not None:
            motion += [state.desired_v, state.desired_a]
        n, stamp = self.safety.robot_model.n, state.stamp
        if not (abs(stamp) <= validation.MAX_STAMP and all(np.shape(values) == (n,) for values in motion)):
            motion, stamp = [np.full(n, nan)] * 2, 0.0
        q, v, *desired = (np.ascontiguousarray(values, float) for values in motion)
        return self._loop.push_state(
            min(max(0, state.sequence), _MAX_SEQUENCE),
            max(0, round(stamp * 1e6)),
            q,
            v,
            opening,
            state.drive_enabled,
            np.concatenate(desired) if desired else np.empty(0),
        )

    def pop_commands(self) -> list[tuple[int, tuple[float, ...], bool]]:
        """Commands since the last call: tick, control (n,) [rad/s], and whether the drive is enabled.

        The last one is the command in force. Of more than 64 the oldest 64 and the newest one are returned.
        """
        return self._loop.pop_commands()

    def estop(self, *, pressed: bool = True) -> None:
        """Press or release the emergency stop. It latches: after its release only `press(RESET)` clears it."""
        self.hold(Condition.ESTOP, active=pressed)

    def hold(self, conditions: int, *, active: bool = True) -> None:
        """Report `Condition` bits of other components until they are reported inactive."""
        known = int(sum(Condition)) & ~BUTTONS
        self._loop.hold(int(conditions) & known, active)

    def press(self, buttons: int) -> None:
        """Press buttons (RESET, RESUME, CONTINUE) for one tick."""
        self._loop.press(int(buttons) & BUTTONS)

    def set_drive(self, *, on: bool) -> None:
        """Switch the drive off at the next tick without a fault, or permit the supervisor to switch it on again.

        As under a decision of the supervisor, it comes on only while the arm is at rest.
        """
        self._loop.set_drive(on)

    def set_speed(self, scale: float) -> None:
        """Set the speed scale in (0, 1].

        Raises:
            ConfigurationError: the scale is out of range.
        """
        if not self._loop.set_speed(float(scale)):
            raise ConfigurationError("speed scale", got=scale, allowed="a number in (0, 1]")

    # --- ticks ------------------------------------------------------------------------------------------------

    def tick(self, now: float) -> None:
        """One tick at `now` [s] of CLOCK_MONOTONIC in the calling thread, for tests; not while the thread runs."""
        self._loop.tick(round(now * 1e6))

    def start(self) -> ControlThreadStatus:
        """Start the thread; `warnings` of the result name missing permissions.

        Raises:
            ControlThreadError: the thread could not be created, runs already, or was stopped.
        """
        if self._started:
            problem = "runs already" if self._loop.status()["running"] else "was stopped, and cannot be started again"
            raise ControlThreadError(f"The control thread {problem}. Make a ControlThread for each start.")
        error = self._loop.start(self._period_us, self.config.priority, self.config.lock_process)
        if error:
            raise ControlThreadError(f"The control thread could not be created: {os.strerror(error)}.")
        self._started = True
        return self.status()

    def stop(self) -> None:
        """Bring the arm to rest, switch the drive off, and end the thread; takes 2 s at most."""
        self._loop.stop()
        if self._link is not None:
            self._link.close()

    def __enter__(self) -> ControlThread:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def __del__(self) -> None:
        """Stop a thread that was not stopped, before its socket is closed."""
        if getattr(self, "_started", False):
            self.stop()

    # --- outputs ----------------------------------------------------------------------------------------------

    def read_log(self) -> NDArray[Any]:
        """Records of the ticks since the last call, oldest first; the fields are those of `dbk_tick_record`."""
        self._loop.call()
        return np.frombuffer(self._loop.drain_log(), self._record_type)

    def take_conditions(self) -> int:
        """`Condition` bits that the loop detected since the last call, without those from outside; none is lost."""
        return self._loop.take_conditions()

    def status(self) -> ControlThreadStatus:
        """State of the thread."""
        values: dict[str, Any] = self._loop.status()
        return ControlThreadStatus(
            running=values["running"],
            finished=values["finished"],
            real_time=values["fifo"],
            memory_lock=_MEMORY_LOCKS[int(values["memory_lock"])],
            late=values["late"],
            skipped=values["skipped"],
            max_late=values["max_late_us"] / 1e6,
            max_work=values["max_work_us"] / 1e6,
            log_dropped=values["log_dropped"],
            refused=values["refused"],
            malformed=values["malformed"],
            unsent=values["unsent"],
            last_tick=values["last_tick_us"] / 1e6,
            warnings=_warnings(values["fifo_error"], values["lock_error"]),
        )

    @staticmethod
    def clock() -> float:
        """Time of the loop [s]: CLOCK_MONOTONIC."""
        return time.monotonic()


def _check_config(config: ControlThreadConfig) -> None:
    if not 0.0 < config.control_valid <= 1.0:
        raise ConfigurationError("control_valid", got=config.control_valid, allowed="a time in (0, 1] s")
    if not config.caller_lost_after >= config.control_valid:
        raise ConfigurationError("caller_lost_after", got=config.caller_lost_after, allowed="at least control_valid")
    if not 0 <= config.priority <= MAX_PRIORITY:
        raise ConfigurationError("priority", got=config.priority, allowed=f"0 to {MAX_PRIORITY}")


def loop_limits(
    safety: SafetyFilter,
    config: ControlThreadConfig,
    timing: Timing,
    monitor: MonitorLimits,
    standstill: StandstillLimits | None = None,
) -> dict[str, Any]:
    """The limits of all checks: the fields of `dbk_control_limits` by name, without `opening_max`.

    Raises:
        ConfigurationError: `standstill` differs from the defaults in more than `slow_scale`.
    """
    model = safety.robot_model
    joints = model.joints
    velocity = np.array([joint.velocity.value for joint in joints])
    rest = standstill or StandstillLimits()
    if rest != StandstillLimits(slow_scale=rest.slow_scale):
        raise ConfigurationError("standstill_limits", got=rest, allowed="the defaults except for slow_scale")
    names = ("max_source_gap", "max_tracking_gap", "tracking_lost_gap", "leak_time", "max_position_jump")
    times = ("tick_lost_after", "state_stale_after", "state_lost_after", "max_loop_delay", "max_clock_skew")
    return {
        "period": max(timing.period, model.period),
        "command_period": model.period,
        **{name: getattr(timing, name) for name in (*times, "drive_on_timeout", "drive_on_silence")},
        **{name: getattr(monitor, name) for name in names},
        "control_valid": config.control_valid,
        "caller_lost_after": config.caller_lost_after,
        "scene_old_after": monitor.scene_old_after,
        "lag": max(model.tracking.lag, timing.period),
        "rest_velocity": rest.rest_velocity,
        "slow_scale": rest.slow_scale,
        "q_least": np.array([joint.lower.value - RANGE_TOLERANCE for joint in joints]),
        "q_most": np.array([joint.upper.value + RANGE_TOLERANCE for joint in joints]),
        "overspeed": monitor.overspeed_factor * velocity,
        "control_limit": 1.001 * velocity,
        "velocity_limit": velocity,
        "braking_step": np.array([joint.acceleration.value for joint in joints]) * model.period,
    }


def simulated_arm(safety: SafetyFilter, posture: ArrayLike | None) -> dict[str, Any]:
    """The simulated arm at rest in `posture` (n,) [rad]: home, braking (n,) [rad/s²] and lag [s]; empty for None."""
    if posture is None:
        return {}
    model = safety.robot_model
    return {
        "home": np.ascontiguousarray(validation.as_real_array("simulated_at", posture, (model.n,)), float),
        "braking": np.array([joint.acceleration.value for joint in model.joints]),
        "lag": max(model.tracking.lag, 0.001),
    }


def _record_type(fields: Sequence[tuple[str, str, int, int]], size: int) -> np.dtype[Any]:
    return np.dtype(
        {
            "names": [name for name, _, _, _ in fields],
            "formats": [kind if count == 1 else (kind, (count,)) for _, kind, count, _ in fields],
            "offsets": [offset for *_, offset in fields],
            "itemsize": size,
        }
    )


def _warnings(fifo_error: int, lock_error: int) -> tuple[str, ...]:
    """Refused permissions, each with its effect and its remedy."""
    found: tuple[str, ...] = ()
    if fifo_error:
        found += (
            f"Real-time scheduling (SCHED_FIFO) was refused: {os.strerror(fifo_error)}. The thread has ordinary "
            "priority, and ticks are late under load. Permit it: 'rtprio 99' for this user in /etc/security/limits.d, "
            "or LimitRTPRIO=99 in the systemd unit.",
        )
    if lock_error:
        found += (
            f"Locking memory was refused: {os.strerror(lock_error)}. A tick may wait for a page of memory. Permit it: "
            "'memlock unlimited' for this user in /etc/security/limits.d, or LimitMEMLOCK=infinity in the systemd "
            "unit.",
        )
    return found
