"""What the supervisor orders: one rung of the ladder, the cause, and the check that gave it (design 4)."""

from __future__ import annotations

from enum import Enum, IntEnum

import msgspec


class SafetyAction(IntEnum):
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

    NONE = "nothing"
    SENSING = "sensing"
    FILTER = "filter"
    TIMING = "timing"
    COMMANDER = "cortex"
    DRIVE = "drive"
    OPERATOR = "operator"
    PROGRAM = "program"


class SupervisorDecision(msgspec.Struct, frozen=True):
    """What holds now. `check` is the name of the strongest check that has tripped ("" for none).

    `at_once`: the drive goes off at once and brakes by itself, whatever the rung.
    """

    action: SafetyAction = SafetyAction.NONE
    cause: Cause = Cause.NONE
    check: str = ""
    immediate_drive_off: bool = False


NO_ACTION = SupervisorDecision()
"""Nothing is wrong."""
