"""What the supervisor orders: one rung of the ladder, the cause, and the check that gave it (design 4)."""

from __future__ import annotations

from enum import Enum, IntEnum

import msgspec


class Rung(IntEnum):
    """The ladder by severity. Stop categories are those of IEC 60204-1, by name only: nothing here is certified.

    SLOW scales the nominal control; HOVER makes it zero, so that the filter may still let the arm yield; HOLD is a
    monitored standstill (category 2); CONTROLLED_STOP brakes, then switches the drive off (category 1); ESTOP switches
    it off at once (category 0); LOCKOUT is an ESTOP that only a restart ends.
    """

    NONE = 0
    WARN = 1
    SLOW = 2
    HOVER = 3
    HOLD = 4
    CONTROLLED_STOP = 5
    ESTOP = 6
    LOCKOUT = 7


class Cause(Enum):
    """Where the trouble is."""

    NOTHING = "nothing"
    SENSING = "sensing"
    FILTER = "filter"
    TIMING = "timing"
    CORTEX = "cortex"
    DRIVE = "drive"
    OPERATOR = "operator"
    PROGRAM = "program"


class Order(msgspec.Struct, frozen=True):
    """What holds now. `check` is the name of the strongest check that has tripped ("" for none).

    `at_once`: the drive goes off at once and brakes by itself, whatever the rung.
    """

    action: Rung = Rung.NONE
    cause: Cause = Cause.NOTHING
    check: str = ""
    at_once: bool = False


FREE = Order()
"""Nothing is wrong."""
