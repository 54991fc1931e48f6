"""How punctual a driver is: the thresholds behind the checks of timing, one set a driver."""

from __future__ import annotations

import msgspec


class Timing(msgspec.Struct, frozen=True, kw_only=True):
    """Times [s] of one driver's bus.

    `period` of its states; `overrun`: a tick that takes longer is late; `late`: a command that leaves later after its
    state; `lost`: a gap between two ticks after which the loop stood still. A joint state older than `stale` cannot be
    filtered, older than `blind` not even braked on. `overruns` is the share of late ticks within the last second that
    is too many. A loop that is `behind` (`lateness.py`) drives on old commands. `clock` is how far two clocks may part
    within one tick. A drive that is switched on is on within `switching`, by the robot's own stamps; until then the bus
    may be silent for `quiet` and nothing is held against it.
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
"""The MuJoCo plant at 1 kHz, on a desktop without real-time guarantees: gaps that the drive bridges are borne."""


def simulated_timing(period: float) -> Timing:
    """The plant of a body whose states come every `period` [s]."""
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
"""1 kHz; a command belongs within 300 µs of its state; 20 packets missed in a row make the arm stop by itself
(libfranka: `communication_constraints_violation`). While a motion is begun, no states come."""
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
"""500 Hz; the controller's own watchdog is set to 100 ms by our driver. Loading its script takes about a second."""
