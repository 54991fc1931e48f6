"""Conditions that the supervisor checks, one bit each. Every tick passes their flags to the supervisor."""

from __future__ import annotations

from enum import IntFlag, auto


class Condition(IntFlag):
    """Conditions as detected in the current tick; the table in `checks.py` states how long each must last."""

    INFEASIBLE = auto()
    FILTER_STOPPED = auto()
    FILTER_FAULT = auto()
    CONTROL_BAD = auto()
    STATE_MISSED = auto()
    STATE_REPEATED = auto()
    STATE_STALE = auto()
    STATE_LOST = auto()
    STATE_IMPLAUSIBLE = auto()
    SOURCES_DISAGREE = auto()
    SCENE_OLD = auto()
    SCENE_STALE = auto()
    SCENE_IMPLAUSIBLE = auto()
    SCENE_FROZEN = auto()
    TICK_OVERRUN = auto()
    TICKS_OVERRUN = auto()
    TICK_LOST = auto()
    LOOP_BEHIND = auto()
    COMMAND_LATE = auto()
    CLOCK_STEP = auto()
    TRACKING_OFF = auto()
    TRACKING_LOST = auto()
    UNEXPECTED_CONTACT = auto()
    OVERSPEED = auto()
    DRIFT = auto()
    STOP_OVERDUE = auto()
    DRIVE_DROPPED = auto()
    FALLING = auto()
    FRAMES_REFUSED = auto()
    HEARTBEAT_LOST = auto()
    LINK_LOST = auto()
    FLOOD = auto()
    SPEED_STAGE = auto()
    PAUSE = auto()
    ABORT = auto()
    TAKEOVER = auto()
    INTERRUPT = auto()
    ESTOP = auto()
    ESTOP_DISAGREE = auto()
    PROGRAM_ERROR = auto()
    RECORDING_LOST = auto()
    RESET = auto()
    RESUME = auto()
    CONTINUE = auto()


BUTTONS = int(Condition.RESET | Condition.RESUME | Condition.CONTINUE)
"""Operator buttons. They count in the tick in which they are pressed, not while they are held. A person presses reset
and resume; continue comes with a new contract and clears checks that need no person."""
