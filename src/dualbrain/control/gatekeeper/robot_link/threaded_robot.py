"""A robot whose joints a control thread in C moves: the gatekeeper's loop supplies controls and scenes.

    states ──► control thread (supervisor, filter, watchdog) ──► commands        every period, without the interpreter
       └─────► control loop (skills, supervisor, filter) ──► u, scene ──┘        as soon as it can

The thread filters the loop's controls again, with the newest state. A late control is a condition (`heartbeat_lost`:
the arm holds), and no delay of the interpreter delays a command.
"""

from __future__ import annotations

from dataclasses import replace
from math import inf
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.control.gatekeeper.robot_link.driver_process import DriverSettings
from dualbrain.control.gatekeeper.robot_link.packet_socket import socket_pair
from dualbrain.control.gatekeeper.robot_link.remote_robot import RemoteRobot
from dualbrain.control.gatekeeper.robot_link.simulated_robot import SimulatedRobotSettings
from dualbrain.control.gatekeeper.robot_link.thread_filter import PASSED_ON, ThreadFilter
from dualbrain.control.gatekeeper.timing.tick_profile import TickProfiler
from dualbrain.robots.interface import Command, RobotState
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.control_thread import ControlThread, ControlThreadConfig, ControlThreadStatus
from dualbrain.safety.supervisor.actions import SafetyAction
from dualbrain.safety.supervisor.checks import CHECKS
from dualbrain.safety.supervisor.conditions import BUTTONS, Condition
from dualbrain.safety.supervisor.enforcement import StandstillLimits
from dualbrain.safety.supervisor.state_monitor import MonitorLimits
from dualbrain.safety.supervisor.timing import Timing

LOOP_TICK_LOST_AFTER = 0.5
"""A longer gap between two ticks of the loop above the thread is a stall that ends the contract [s]."""
THREAD_CONFIG = ControlThreadConfig(forces_supervised=True, caller_lost_after=LOOP_TICK_LOST_AFTER)
"""The gatekeeper supervises contact forces, and the thread stops the arm if the loop hangs."""
FOLLOWED = 0.25
"""The loop's control counts as executed up to this share of the largest change of a control in one period."""
NOT_OWN = int(BUTTONS | Condition.HEARTBEAT_LOST)
UNCOMPARED = MonitorLimits(max_source_gap=inf, max_tracking_gap=inf, tracking_lost_gap=inf)
"""Limits of the loop, which misses states while it is late. The thread compares positions, velocities and commands."""


def loop_timing(timing: Timing, control_valid: float) -> Timing:
    """Limits of the loop above a thread that keeps `timing`: a control is late when it is no longer in force."""
    return msgspec.structs.replace(
        timing,
        max_tick_time=control_valid,
        command_deadline=control_valid,
        tick_lost_after=LOOP_TICK_LOST_AFTER,
        max_loop_delay=LOOP_TICK_LOST_AFTER,
        state_stale_after=max(timing.state_stale_after, control_valid),
        state_lost_after=max(timing.state_lost_after, 3.0 * control_valid),
    )


class ThreadedRobot(RemoteRobot):
    """A robot in another process behind a control thread; call `make_filter` before the first command."""

    def __init__(
        self, settings: SimulatedRobotSettings | DriverSettings, timing: Timing, profiler: TickProfiler | None = None
    ) -> None:
        """Start the process of the robot; `timing` are the limits of the thread, and `loop_timing` those of the loop.

        Raises as `RemoteRobot`.
        """
        self._thread_timing, self._drive_initially_on = timing, isinstance(settings, SimulatedRobotSettings)
        self.loop_timing = loop_timing(timing, THREAD_CONFIG.control_valid)
        self._control_end, robot_end = socket_pair()
        self._filter: ThreadFilter | None = None
        self._thread: ControlThread | None = None
        self._held = 0
        self._notes: list[str] = []
        self._record: NDArray[Any] | None = None
        self._late = self._stops_agree = False
        self._unrecorded: list[NDArray[Any]] = []
        self._followed_gap = np.zeros(0)
        super().__init__(settings, self.loop_timing, profiler, control_end=robot_end)

    def make_filter(
        self, robot_model: RobotModel, config: FilterConfig | None, obstacles: tuple[Obstacle, ...]
    ) -> ThreadFilter:
        """The filter of the loop, and the start of the thread with its robot and its scene.

        Raises:
            ConfigurationError: the base is mobile.
            ControlThreadError: the thread could not be created.
        """
        made = ThreadFilter(robot_model, config, obstacles=obstacles, thread_conditions=self._thread_conditions)
        self._control_end.setblocking(False)
        self._thread = ControlThread(
            made,
            THREAD_CONFIG,
            timing=self._thread_timing,
            standstill_limits=StandstillLimits(slow_scale=1.0),  # the loop slows its controls itself
            link=self._control_end,
        )
        self._thread.set_drive(on=self._drive_initially_on)
        self._filter, made.scene_changed = made, False
        accelerations = [joint.acceleration.value for joint in robot_model.joints]
        self._followed_gap = FOLLOWED * robot_model.period * np.array(accelerations)
        self._notes += self._thread.start().warnings
        return made

    # --- robot --------------------------------------------------------------------------------------------------

    def read(self) -> RobotState:
        """The newest joint state; the desired motion in it is that of the thread where it differs from the loop's."""
        state = super().read()
        if state.desired_v is not None:
            state = replace(state, desired_v=None, desired_a=None)
        record = self._record
        if record is None or not self._deviates(record):
            return state
        n = len(state.v)
        return replace(state, desired_v=record["u"][:n].copy(), desired_a=np.zeros(n))

    def write(self, command: Command) -> None:
        """Pass the scene and the control to the thread, and the command of the gripper to the robot."""
        super().write(command)
        self._submit_scene()
        thread, safety = self._running
        thread.submit_control(command.u, standstill=safety.standstill)

    def stop(self) -> None:
        """Drive off: in the next tick of the thread, and by the other link, should the thread be late."""
        if self._thread is not None:
            self._thread.set_drive(on=False)
        super().stop()

    def enable(self) -> None:
        """Drive on, as soon as the supervisor of the thread agrees."""
        if self._thread is not None:
            self._thread.set_drive(on=True)

    # --- environment --------------------------------------------------------------------------------------------

    def advance(self) -> None:
        """Pass the buttons of this tick to the thread, wait for the next joint state, and read the thread's log."""
        self._submit_scene()
        self._pass_conditions_on()
        super().advance()
        self._read_log()

    def notes(self) -> list[str]:
        """Permissions that the thread lacks, and the beginning and end of late controls."""
        notes, self._notes = self._notes, []
        return notes

    def thread_ticks(self) -> NDArray[Any] | None:
        """Records of the executed ticks of the thread since the last call, None without one."""
        unrecorded, self._unrecorded = self._unrecorded, []
        return np.concatenate(unrecorded) if unrecorded else None

    def thread_status(self) -> ControlThreadStatus:
        """State of the thread."""
        return self._running[0].status()

    def close(self) -> None:
        """Bring the arm to rest, end the thread, and end the robot process."""
        if self._thread is not None:
            self._thread.stop()
        super().close()

    # --- inside -------------------------------------------------------------------------------------------------

    @property
    def _running(self) -> tuple[ControlThread, ThreadFilter]:
        if self._thread is None or self._filter is None:
            raise RuntimeError("make_filter has not been called")
        return self._thread, self._filter

    def _submit_scene(self) -> None:
        thread, safety = self._running
        if safety.scene_changed:
            safety.scene_changed = False
            thread.submit_scene()

    def _pass_conditions_on(self) -> None:
        thread, safety = self._running
        if changed := (safety.conditions ^ self._held):
            thread.hold(changed & safety.conditions, active=True)
            thread.hold(changed & ~safety.conditions & PASSED_ON, active=False)
            self._held = safety.conditions
        if safety.pressed:
            thread.press(safety.pressed)
            safety.pressed = 0

    def _read_log(self) -> None:
        records = self._running[0].read_log()
        if not len(records):
            return
        self._record = records[-1]
        self._unrecorded.append(records)
        late = bool(records["external"][-1] & int(Condition.HEARTBEAT_LOST)) and not records["drive_off"][-1]
        if late != self._late:
            self._late = late
            text = "the controls are late: the arm holds" if late else "the controls are in time again"
            self._notes.append(text)

    def _thread_conditions(self) -> int:
        """Conditions that the thread detected, and that of a stop which only the thread has decided."""
        found = self._running[0].take_conditions() | self._stop_condition()
        return found & ~NOT_OWN

    def _stop_condition(self) -> int:
        """The condition of a stop of the thread, until the loop has stopped, too; a later end is that of each alone."""
        record = self._record
        if record is None or record["action"] < SafetyAction.CONTROLLED_STOP:
            self._stops_agree = False
            return 0
        self._stops_agree |= self._running[1].stopped
        check = int(record["check"])
        if self._stops_agree or check >= len(CHECKS):
            return 0
        return int(CHECKS[check].condition) & ~int(record["external"])

    def _deviates(self, record: NDArray[Any]) -> bool:
        """Whether the thread executes another control than the loop's newest one that it has."""
        if int(record["external"]) & int(Condition.HEARTBEAT_LOST):
            return True
        n = len(self._followed_gap)
        gap = np.abs(record["u"][:n] - record["u_nom"][:n])
        return bool((gap > self._followed_gap).any())
