"""The table of checks: for each hazard its action, how long it must last, when it clears, what becomes of a contract.

Docs (`python -m dualbrain.safety.supervisor.checks > docs/supervisor.md`), dashboard, supervisor and tests read this one table.
Its order is the order of severity: of two checks that have tripped, the later one gives the order.
"""

from __future__ import annotations

import sys
from enum import Enum
from typing import Literal

import msgspec

from dualbrain.safety.supervisor.actions import Cause, SafetyAction
from dualbrain.safety.supervisor.conditions import Condition

C = Condition
ContractOutcome = Literal["", "taken_over", "stopped", "aborted", "handed_over", "emergency"]


class ClearPolicy(Enum):
    """When a check that has tripped lets go."""

    WHEN_GONE = "by itself, once the condition has been gone for its release time"
    ON_CONTINUE = "once the condition is gone and the next contract begins, or a person resumes"
    ON_RESUME = "when a person resumes"
    ON_TWO_STEP_RESET = "after two steps: the condition is gone, then a fresh press of reset; lands in HOLD"
    ON_RESTART = "never; only a restart"


class Check(msgspec.Struct, frozen=True, kw_only=True):
    """One row. `after` [s]: how long the condition must last; `release` [s]: how long it must be gone to count as gone.

    `ending` is the outcome of the contract that it ends ("": the contract goes on). `at_once`: a CONTROLLED_STOP in
    which the drive goes off at once and brakes by itself, because the filter that would brake is what is broken.
    """

    name: str
    condition: Condition
    action: SafetyAction
    cause: Cause
    description: str
    after: float = 0.0
    release: float = 0.02
    clears: ClearPolicy = ClearPolicy.WHEN_GONE
    contract_outcome: ContractOutcome = ""
    immediate_drive_off: bool = False


WHEN_GONE, ON_CONTINUE, ON_RESUME, ON_TWO_STEP_RESET, ON_RESTART = ClearPolicy

CHECKS: tuple[Check, ...] = (
    Check(
        name="state_missed",
        condition=C.STATE_MISSED,
        action=SafetyAction.WARN,
        cause=Cause.TIMING,
        description="joint states were lost on the way",
        release=1.0,
    ),
    Check(
        name="state_repeated",
        condition=C.STATE_REPEATED,
        action=SafetyAction.WARN,
        cause=Cause.TIMING,
        description="the same joint state came again",
    ),
    Check(
        name="tick_overrun",
        condition=C.TICK_OVERRUN,
        action=SafetyAction.WARN,
        cause=Cause.TIMING,
        description="a control tick took longer than its period",
        release=1.0,
    ),
    Check(
        name="command_late",
        condition=C.COMMAND_LATE,
        action=SafetyAction.WARN,
        cause=Cause.TIMING,
        description="a command left late in its period",
        release=1.0,
    ),
    Check(
        name="frames_refused",
        condition=C.FRAMES_REFUSED,
        action=SafetyAction.WARN,
        cause=Cause.COMMANDER,
        description="a message was refused: form, signature, order",
        release=0.5,
    ),
    Check(
        name="infeasible_briefly",
        condition=C.INFEASIBLE,
        action=SafetyAction.WARN,
        cause=Cause.FILTER,
        description="no control meets all rows; the filter brakes",
    ),
    Check(
        name="filter_stopped_briefly",
        condition=C.FILTER_STOPPED | C.FILTER_FAULT,
        action=SafetyAction.WARN,
        cause=Cause.FILTER,
        description="the filter has stopped or cannot certify; it brakes",
    ),
    Check(
        name="speed_stage",
        condition=C.SPEED_STAGE,
        action=SafetyAction.SLOW,
        cause=Cause.OPERATOR,
        description="a person has chosen a lower speed",
        release=0.0,
    ),
    Check(
        name="scene_old",
        condition=C.SCENE_OLD,
        action=SafetyAction.SLOW,
        cause=Cause.SENSING,
        description="the scene is older than a few looks",
        release=0.1,
    ),
    Check(
        name="ticks_overrun",
        condition=C.TICKS_OVERRUN,
        action=SafetyAction.SLOW,
        cause=Cause.TIMING,
        description="many control ticks of the last second were late",
        release=1.0,
    ),
    Check(
        name="paused",
        condition=C.PAUSE,
        action=SafetyAction.HOVER,
        cause=Cause.OPERATOR,
        description="a person has paused the contract",
        release=0.0,
    ),
    Check(
        name="infeasible",
        condition=C.INFEASIBLE,
        action=SafetyAction.HOVER,
        cause=Cause.FILTER,
        description="no safe control for 50 ms",
        after=0.05,
        release=0.1,
        contract_outcome="taken_over",
    ),
    Check(
        name="scene_stale",
        condition=C.SCENE_STALE,
        action=SafetyAction.HOLD,
        cause=Cause.SENSING,
        description="moving things were seen too long ago",
        after=0.05,
        release=0.2,
        contract_outcome="stopped",
    ),
    Check(
        name="scene_implausible",
        condition=C.SCENE_IMPLAUSIBLE,
        action=SafetyAction.HOLD,
        cause=Cause.SENSING,
        description="the scene holds numbers that cannot be, or is stamped in the future",
        release=0.2,
        contract_outcome="stopped",
    ),
    Check(
        name="scene_frozen",
        condition=C.SCENE_FROZEN,
        action=SafetyAction.HOLD,
        cause=Cause.SENSING,
        description="a camera tells the same picture again and again, equal to the bit and stamped anew",
        release=0.2,
        contract_outcome="stopped",
    ),
    Check(
        name="heartbeat_lost",
        condition=C.HEARTBEAT_LOST,
        action=SafetyAction.HOLD,
        cause=Cause.COMMANDER,
        description="the commander has gone silent",
        release=0.1,
        contract_outcome="stopped",
    ),
    Check(
        name="link_lost",
        condition=C.LINK_LOST,
        action=SafetyAction.HOLD,
        cause=Cause.COMMANDER,
        description="the commander's connection is gone",
        release=0.1,
        contract_outcome="stopped",
    ),
    Check(
        name="flood",
        condition=C.FLOOD,
        action=SafetyAction.HOLD,
        cause=Cause.COMMANDER,
        description="the commander sends more than it may",
        release=0.5,
        contract_outcome="stopped",
    ),
    Check(
        name="abort",
        condition=C.ABORT,
        action=SafetyAction.HOLD,
        cause=Cause.OPERATOR,
        description="a person has ended the contract",
        release=0.2,
        contract_outcome="aborted",
    ),
    Check(
        name="takeover",
        condition=C.TAKEOVER,
        action=SafetyAction.HOLD,
        cause=Cause.OPERATOR,
        description="a person has taken the robot over",
        release=0.2,
        contract_outcome="handed_over",
    ),
    Check(
        name="state_stale",
        condition=C.STATE_STALE,
        action=SafetyAction.CONTROLLED_STOP,
        cause=Cause.SENSING,
        description="the joint state is too old",
        release=0.5,
        clears=ON_CONTINUE,
        contract_outcome="stopped",
    ),
    Check(
        name="state_implausible",
        condition=C.STATE_IMPLAUSIBLE,
        action=SafetyAction.CONTROLLED_STOP,
        cause=Cause.SENSING,
        description="the joint state is not finite, jumps, or lies far outside the joints' range",
        release=0.5,
        clears=ON_CONTINUE,
        contract_outcome="stopped",
    ),
    Check(
        name="sources_disagree",
        condition=C.SOURCES_DISAGREE,
        action=SafetyAction.CONTROLLED_STOP,
        cause=Cause.SENSING,
        description="measured positions and measured velocities do not tell the same motion",
        release=0.5,
        clears=ON_CONTINUE,
        contract_outcome="stopped",
    ),
    Check(
        name="tracking_off",
        condition=C.TRACKING_OFF,
        action=SafetyAction.CONTROLLED_STOP,
        cause=Cause.DRIVE,
        description="the arm is not where its commands led it",
        release=0.5,
        clears=ON_CONTINUE,
        contract_outcome="stopped",
    ),
    Check(
        name="filter_stopped",
        condition=C.FILTER_STOPPED,
        action=SafetyAction.CONTROLLED_STOP,
        cause=Cause.FILTER,
        description="filter STOPPED for 50 ms",
        after=0.05,
        release=0.5,
        clears=ON_CONTINUE,
        contract_outcome="stopped",
    ),
    Check(
        name="filter_fault",
        condition=C.FILTER_FAULT,
        action=SafetyAction.CONTROLLED_STOP,
        cause=Cause.FILTER,
        description="filter FAULT for 50 ms: not even braking could be certified",
        after=0.05,
        release=0.5,
        clears=ON_CONTINUE,
        contract_outcome="stopped",
    ),
    Check(
        name="control_bad",
        condition=C.CONTROL_BAD,
        action=SafetyAction.CONTROLLED_STOP,
        cause=Cause.FILTER,
        description="the control is not finite, leaves the joints' box or answers another question; braking is written instead",
        release=0.5,
        clears=ON_CONTINUE,
        contract_outcome="stopped",
    ),
    Check(
        name="tick_lost",
        condition=C.TICK_LOST,
        action=SafetyAction.CONTROLLED_STOP,
        cause=Cause.TIMING,
        description="the control loop stood still for too long",
        release=0.5,
        clears=ON_CONTINUE,
        contract_outcome="stopped",
    ),
    Check(
        name="clock_step",
        condition=C.CLOCK_STEP,
        action=SafetyAction.CONTROLLED_STOP,
        cause=Cause.TIMING,
        description="the clock jumped or ran backward",
        release=0.5,
        clears=ON_CONTINUE,
        contract_outcome="stopped",
    ),
    Check(
        name="interrupted",
        condition=C.INTERRUPT,
        action=SafetyAction.CONTROLLED_STOP,
        cause=Cause.OPERATOR,
        description="a person has interrupted the program",
        release=0.5,
        clears=ON_CONTINUE,
        contract_outcome="aborted",
    ),
    Check(
        name="loop_behind",
        condition=C.LOOP_BEHIND,
        action=SafetyAction.CONTROLLED_STOP,
        cause=Cause.TIMING,
        description="the control loop falls behind the robot: commands stay in force too long",
        release=0.5,
        clears=ON_CONTINUE,
        contract_outcome="stopped",
        immediate_drive_off=True,
    ),
    Check(
        name="state_lost",
        condition=C.STATE_LOST,
        action=SafetyAction.ESTOP,
        cause=Cause.SENSING,
        description="no joint state for so long that braking is blind",
        clears=ON_TWO_STEP_RESET,
        contract_outcome="emergency",
    ),
    Check(
        name="tracking_lost",
        condition=C.TRACKING_LOST,
        action=SafetyAction.ESTOP,
        cause=Cause.DRIVE,
        description="the drive does not follow its commands at all",
        clears=ON_TWO_STEP_RESET,
        contract_outcome="emergency",
    ),
    Check(
        name="overspeed",
        condition=C.OVERSPEED,
        action=SafetyAction.ESTOP,
        cause=Cause.DRIVE,
        description="a joint is faster than its limit",
        clears=ON_TWO_STEP_RESET,
        contract_outcome="emergency",
    ),
    Check(
        name="drift",
        condition=C.DRIFT,
        action=SafetyAction.ESTOP,
        cause=Cause.DRIVE,
        description="the arm moves in a monitored standstill",
        clears=ON_TWO_STEP_RESET,
        contract_outcome="emergency",
    ),
    Check(
        name="stop_overdue",
        condition=C.STOP_OVERDUE,
        action=SafetyAction.ESTOP,
        cause=Cause.DRIVE,
        description="a stop was ordered and the arm still moves",
        clears=ON_TWO_STEP_RESET,
        contract_outcome="emergency",
    ),
    Check(
        name="drive_dropped",
        condition=C.DRIVE_DROPPED,
        action=SafetyAction.ESTOP,
        cause=Cause.DRIVE,
        description="the drive went off unasked",
        clears=ON_TWO_STEP_RESET,
        contract_outcome="emergency",
    ),
    Check(
        name="program_error",
        condition=C.PROGRAM_ERROR,
        action=SafetyAction.ESTOP,
        cause=Cause.PROGRAM,
        description="the program broke",
        clears=ON_TWO_STEP_RESET,
        contract_outcome="stopped",
    ),
    Check(
        name="estop",
        condition=C.ESTOP,
        action=SafetyAction.ESTOP,
        cause=Cause.OPERATOR,
        description="the emergency stop was pressed",
        clears=ON_TWO_STEP_RESET,
        contract_outcome="emergency",
    ),
    Check(
        name="estop_disagrees",
        condition=C.ESTOP_DISAGREE,
        action=SafetyAction.LOCKOUT,
        cause=Cause.OPERATOR,
        description="the two channels of the emergency stop contradict each other",
        after=0.5,
        clears=ON_RESTART,
        contract_outcome="emergency",
    ),
    Check(
        name="falling",
        condition=C.FALLING,
        action=SafetyAction.LOCKOUT,
        cause=Cause.DRIVE,
        description="the arm moves though its brakes should hold it",
        clears=ON_RESTART,
        contract_outcome="emergency",
    ),
)
RESET_HELD = Check(
    name="reset_held",
    condition=C.RESET,
    action=SafetyAction.HOLD,
    cause=Cause.OPERATOR,
    description="after a reset the robot stands until somebody resumes",
    clears=ON_RESUME,
)
"""Where a two-step reset lands; ranks as any HOLD."""

HEADER = """# The supervisor

What the local layer does when something is wrong. One function, `Supervisor.update(now, flags)`, turns the conditions
of a tick into one order: the strongest check that has tripped. This page is generated from the table that it reads
(`python -m dualbrain.safety.supervisor.checks > docs/supervisor.md`); `tests/safety/supervisor/test_supervisor.py` tries all combinations.

The ladder: NONE < WARN < SLOW (the nominal control is scaled) < HOVER (zero through the filter, which may still let the
arm yield) < HOLD (monitored standstill, category 2) < CONTROLLED_STOP (brakes, then the drive goes off, category 1) <
ESTOP (drive off at once, category 0) < LOCKOUT (only a restart ends it). The categories are those of IEC 60204-1 by
name only; **nothing here is certified**.

- A condition must last `after` before its check trips; gaps shorter than `release` do not interrupt it
  (anti-chatter).
- An ESTOP is latched. First its condition must go; then a *fresh* press of reset leads into HOLD; then `resume` leads
  out. A reset that was held from before does nothing.
- A CONTROLLED_STOP leaves the drive off until its condition is gone and the next contract begins. Where the loop itself
  is late, it does not wait for the filter to brake: the drive goes off at once and brakes by itself.
- Whatever ends a contract ends it with the outcome named here; only ESTOP and LOCKOUT need a person.
- How conditions are sensed, with their thresholds: `safety/supervisor/state_monitor.py`, `safety/supervisor/timing.py`, `safety/supervisor/enforcement.py`."""


def render_markdown() -> str:
    """The whole page."""
    head = ["| check | when | after | action | cause | contract | clears |", "|---|---|---|---|---|---|---|"]
    return "\n".join([HEADER, "", *head, *(_table_row(check) for check in (*CHECKS, RESET_HELD))]) + "\n"


def _table_row(check: Check) -> str:
    after = f"{check.after * 1e3:.0f} ms" if check.after else "at once"
    gone = {
        WHEN_GONE: f"gone for {check.release * 1e3:.0f} ms" if check.release else "when gone",
        ON_CONTINUE: f"gone for {check.release * 1e3:.0f} ms, and the next contract",
        ON_RESUME: "resume",
        ON_TWO_STEP_RESET: "two-step reset",
        ON_RESTART: "restart",
    }
    ending = check.contract_outcome.replace("_", " ") or "goes on"
    action = f"{check.action.name}, drive off at once" if check.immediate_drive_off else check.action.name
    return (
        f"| `{check.name}` | {check.description} | {after} | {action} | {check.cause.value} | {ending} | "
        f"{gone[check.clears]} |"
    )


if __name__ == "__main__":
    sys.stdout.write(render_markdown())
