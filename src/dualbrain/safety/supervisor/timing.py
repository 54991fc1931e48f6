"""How punctual a driver is: the thresholds behind the checks of timing, one set a driver."""

from __future__ import annotations

import msgspec


class Timing(msgspec.Struct, frozen=True):
    """Times [s] of one driver's bus.

    `period` of its states; `overrun`: a tick that takes longer is late; `late`: a command that leaves later after its
    state; `lost`: a gap between two ticks after which the loop stood still. A joint state older than `stale` cannot be
    filtered, older than `blind` not even braked on. `overruns` is the share of late ticks within the last second that
    is too many. A loop that is `behind` (`lateness.py`) drives on old commands. `clock` is how far two clocks may part
    within one tick. A drive that is switched on is on within `switching`, by the robot's own stamps; until then the bus
    may be silent for `quiet` and nothing is held against it.
    """

    period: float = 0.001
    overrun: float = 0.001
    late: float = 0.0008
    lost: float = 0.1
    stale: float = 0.05
    blind: float = 0.15
    overruns: float = 0.2
    behind: float = 0.05
    clock: float = 0.02
    switching: float = 0.3
    quiet: float = 0.0


SIMULATED = Timing()
"""The MuJoCo plant at 1 kHz, on a desktop without real-time guarantees: gaps that the drive bridges are borne."""


def simulated(period: float) -> Timing:
    """The plant of a body whose states come every `period` [s]."""
    return msgspec.structs.replace(SIMULATED, period=period, overrun=period, late=0.8 * period)


FRANKA = Timing(period=0.001, overrun=0.001, late=0.0003, lost=0.015, stale=0.015, blind=0.02, behind=0.01, quiet=0.5)
"""1 kHz; a command belongs within 300 µs of its state; 20 packets missed in a row make the arm stop by itself
(libfranka: `communication_constraints_violation`). While a motion is begun, no states come."""
UR = Timing(period=0.002, overrun=0.002, late=0.0016, lost=0.03, stale=0.03, blind=0.1, behind=0.02, switching=3.0)
"""500 Hz; the controller's own watchdog is set to 100 ms by our driver. Loading its script takes about a second."""
