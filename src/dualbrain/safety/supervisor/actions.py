"""Decision of the supervisor: an action, its cause, and the check that tripped (design 4)."""

from __future__ import annotations

from enum import Enum, IntEnum

import msgspec


class SafetyAction(IntEnum):
    """Actions by severity. Stop categories are those of IEC 60204-1, by name only: nothing here is certified.

    - NONE: no action. WARN: a warning is logged.
    - SLOW: the nominal control is scaled.
    - HOVER: the nominal control is zero; the filter may still move the arm away from obstacles.
    - HOLD: monitored standstill (category 2).
    - CONTROLLED_STOP: the arm brakes, then the drive is switched off (category 1).
    - ESTOP: the drive is switched off at once (category 0).
    - LOCKOUT: an ESTOP that only a restart ends.
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
    """The part of the system in which the problem is."""

    NONE = "nothing"
    SENSING = "sensing"
    FILTER = "filter"
    TIMING = "timing"
    COMMANDER = "cortex"
    DRIVE = "drive"
    OPERATOR = "operator"
    PROGRAM = "program"
    CONTACT = "contact"


class SupervisorDecision(msgspec.Struct, frozen=True):
    """The action in force. `check` is the name of the strongest check that has tripped ("" if none has).

    With `immediate_drive_off` the drive is switched off at once and brakes by itself, for any action.
    """

    action: SafetyAction = SafetyAction.NONE
    cause: Cause = Cause.NONE
    check: str = ""
    immediate_drive_off: bool = False


NO_ACTION = SupervisorDecision()
"""The decision if no check has tripped."""
