"""Timing limits of robot drivers: the thresholds of the timing checks, one set per driver."""

from __future__ import annotations

import msgspec


class Timing(msgspec.Struct, frozen=True, kw_only=True):
    """Timing limits of one driver, in s.

    - `period` of joint states. `max_tick_time`: a longer tick overruns. `command_deadline`: latest time of a command
      after its state. `tick_lost_after`: a longer gap between two ticks is a stall of the loop.
    - `state_stale_after`: age above which the filter rejects a joint state. `state_lost_after`: age above which not
      even braking is possible.
    - `max_overrun_fraction`: accepted fraction of late ticks within the last second.
    - `max_loop_delay`: largest accumulated delay, see `loop_delay`.
    - `max_clock_skew`: accepted difference between two clocks within one tick.
    - `drive_on_timeout`: time after which a requested drive must be on, by the robot's stamps. `drive_on_silence`: time
      for which the robot may send no states after the request.
    """

    period: float = 0.001
    max_tick_time: float = 0.001
    command_deadline: float = 0.0008
    tick_lost_after: float = 0.1
    state_stale_after: float = 0.05
    state_lost_after: float = 0.15
    max_overrun_fraction: float = 0.2
    max_loop_delay: float = 0.05
    max_clock_skew: float = 0.02
    drive_on_timeout: float = 0.3
    drive_on_silence: float = 0.0


SIMULATED = Timing()
"""MuJoCo plant at 1 kHz on a desktop without real-time guarantees; gaps that the drive bridges are accepted."""


def simulated_timing(period: float) -> Timing:
    """Limits of a simulated robot whose states come every `period` [s]."""
    return msgspec.structs.replace(SIMULATED, period=period, max_tick_time=period, command_deadline=0.8 * period)


FRANKA = Timing(
    period=0.001,
    max_tick_time=0.001,
    command_deadline=0.0003,
    tick_lost_after=0.015,
    state_stale_after=0.015,
    state_lost_after=0.02,
    max_loop_delay=0.01,
    drive_on_silence=0.5,
)
"""1 kHz. A command must follow its state within 300 µs. After 20 missed packets in a row the arm stops by itself
(libfranka: `communication_constraints_violation`). The robot sends no states while a motion starts."""
UR = Timing(
    period=0.002,
    max_tick_time=0.002,
    command_deadline=0.0016,
    tick_lost_after=0.03,
    state_stale_after=0.03,
    state_lost_after=0.1,
    max_loop_delay=0.02,
    drive_on_timeout=3.0,
)
"""500 Hz. The driver sets the watchdog of the controller to 100 ms. Loading the script takes about one second."""
