"""How punctual a driver is: the thresholds behind the checks of timing, one set a driver."""

from __future__ import annotations

import msgspec


class Timing(msgspec.Struct, frozen=True):
    """Times [s] of one driver's bus.

    `period` of its states; `overrun`: a tick that takes longer is late; `late`: a command that leaves later after its
    state; `lost`: a gap between two ticks after which the loop stood still. A joint state older than `stale` cannot be
    filtered, older than `blind` not even braked on. `overruns` is the share of late ticks within the last second that
    is too many. `clock` is how far two clocks may part within one tick.
    """

    period: float = 0.001
    overrun: float = 0.001
    late: float = 0.0008
    lost: float = 0.1
    stale: float = 0.05
    blind: float = 0.15
    overruns: float = 0.2
    clock: float = 0.02


SIMULATED = Timing()
"""The MuJoCo plant at 1 kHz, on a desktop without real-time guarantees: gaps that the drive bridges are borne."""
FRANKA = Timing(period=0.001, overrun=0.001, late=0.0003, lost=0.015, stale=0.015, blind=0.02)
"""1 kHz; a command belongs within 300 µs of its state; 20 packets missed in a row make the arm stop by itself
(libfranka: `communication_constraints_violation`)."""
UR = Timing(period=0.002, overrun=0.002, late=0.0016, lost=0.03, stale=0.03, blind=0.1)
"""500 Hz; the controller's own watchdog is set to 100 ms by our driver."""
