"""Table of checks: for each hazard the action, the durations, how the check clears, and the outcome of the contract.

The documentation page, the dashboard, the supervisor and the tests read this table. Its order is the order of severity:
the last of several tripped checks determines the decision. Write the page with

    python -m dualbrain.safety.supervisor.checks > docs/reference/safety/supervisor.md
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
    """How a tripped check clears."""

    WHEN_GONE = "by itself, after the condition has been gone for the release time"
    ON_CONTINUE = "after the condition is gone and the next contract begins or a person resumes"
    ON_RESUME = "when a person resumes"
    ON_TWO_STEP_RESET = "in two steps: the condition is gone, then reset is pressed; the robot then holds"
    ON_RESTART = "never; only a restart clears it"


class Check(msgspec.Struct, frozen=True, kw_only=True):
    """One row of the table.

    `after` [s] is how long the condition must be present, `release` [s] how long it must be absent to count as gone.
    `contract_outcome` is the outcome of a contract that the check ends ("": the contract continues).
    `immediate_drive_off` marks a CONTROLLED_STOP in which the drive is switched off at once and brakes by itself,
    because the filter that would brake is affected by the fault.
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
        description="joint states were lost in transmission",
        release=1.0,
    ),
    Check(
        name="state_repeated",
        condition=C.STATE_REPEATED,
        action=SafetyAction.WARN,
        cause=Cause.TIMING,
        description="a joint state arrived twice",
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
        description="a command was sent late in its period",
        release=1.0,
    ),
    Check(
        name="frames_refused",
        condition=C.FRAMES_REFUSED,
        action=SafetyAction.WARN,
        cause=Cause.COMMANDER,
        description="a message was rejected for its form, signature or sequence number",
        release=0.5,
    ),
    Check(
        name="infeasible_briefly",
        condition=C.INFEASIBLE,
        action=SafetyAction.WARN,
        cause=Cause.FILTER,
        description="no control satisfies all rows; the filter brakes",
    ),
    Check(
        name="filter_stopped_briefly",
        condition=C.FILTER_STOPPED | C.FILTER_FAULT,
        action=SafetyAction.WARN,
        cause=Cause.FILTER,
        description="the filter stopped or could not certify its control; it brakes",
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
        description="the last few observations of the scene are missing",
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
        description="the last observation of moving objects is too old",
        after=0.05,
        release=0.2,
        contract_outcome="stopped",
    ),
    Check(
        name="scene_implausible",
        condition=C.SCENE_IMPLAUSIBLE,
        action=SafetyAction.HOLD,
        cause=Cause.SENSING,
        description="the scene contains impossible values or has a stamp in the future",
        release=0.2,
        contract_outcome="stopped",
    ),
    Check(
        name="scene_frozen",
        condition=C.SCENE_FROZEN,
        action=SafetyAction.HOLD,
        cause=Cause.SENSING,
        description="a camera repeats the same observation bit for bit with new stamps",
        release=0.2,
        contract_outcome="stopped",
    ),
    Check(
        name="heartbeat_lost",
        condition=C.HEARTBEAT_LOST,
        action=SafetyAction.HOLD,
        cause=Cause.COMMANDER,
        description="the commander sends no heartbeat",
        release=0.1,
        contract_outcome="stopped",
    ),
    Check(
        name="link_lost",
        condition=C.LINK_LOST,
        action=SafetyAction.HOLD,
        cause=Cause.COMMANDER,
        description="the connection to the commander is lost",
        release=0.1,
        contract_outcome="stopped",
    ),
    Check(
        name="flood",
        condition=C.FLOOD,
        action=SafetyAction.HOLD,
        cause=Cause.COMMANDER,
        description="the commander exceeds the rate limit",
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
        description="the joint state is not finite, jumps, or is far outside the joint ranges",
        release=0.5,
        clears=ON_CONTINUE,
        contract_outcome="stopped",
    ),
    Check(
        name="sources_disagree",
        condition=C.SOURCES_DISAGREE,
        action=SafetyAction.CONTROLLED_STOP,
        cause=Cause.SENSING,
        description="measured positions and measured velocities are inconsistent",
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
        name="unexpected_contact",
        condition=C.UNEXPECTED_CONTACT,
        action=SafetyAction.CONTROLLED_STOP,
        cause=Cause.CONTACT,
        description="a contact force is above its limit; the arm yields to it and stops",
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
        description="filter FAULT for 50 ms: even braking could not be certified",
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
        description="the control is not finite, exceeds joint limits or belongs to another input; the arm brakes",
        release=0.5,
        clears=ON_CONTINUE,
        contract_outcome="stopped",
    ),
    Check(
        name="tick_lost",
        condition=C.TICK_LOST,
        action=SafetyAction.CONTROLLED_STOP,
        cause=Cause.TIMING,
        description="the control loop stalled for too long",
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
        name="recording_lost",
        condition=C.RECORDING_LOST,
        action=SafetyAction.CONTROLLED_STOP,
        cause=Cause.PROGRAM,
        description="the recording cannot be written, so the arm would move unrecorded",
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
        description="no joint state for so long that the filter cannot brake safely",
        clears=ON_TWO_STEP_RESET,
        contract_outcome="emergency",
    ),
    Check(
        name="tracking_lost",
        condition=C.TRACKING_LOST,
        action=SafetyAction.ESTOP,
        cause=Cause.DRIVE,
        description="the drive does not follow its commands",
        clears=ON_TWO_STEP_RESET,
        contract_outcome="emergency",
    ),
    Check(
        name="overspeed",
        condition=C.OVERSPEED,
        action=SafetyAction.ESTOP,
        cause=Cause.DRIVE,
        description="a joint exceeds its velocity limit",
        clears=ON_TWO_STEP_RESET,
        contract_outcome="emergency",
    ),
    Check(
        name="drift",
        condition=C.DRIFT,
        action=SafetyAction.ESTOP,
        cause=Cause.DRIVE,
        description="the arm moves during a monitored standstill",
        clears=ON_TWO_STEP_RESET,
        contract_outcome="emergency",
    ),
    Check(
        name="stop_overdue",
        condition=C.STOP_OVERDUE,
        action=SafetyAction.ESTOP,
        cause=Cause.DRIVE,
        description="the arm still moves after the time limit of a stop",
        clears=ON_TWO_STEP_RESET,
        contract_outcome="emergency",
    ),
    Check(
        name="drive_dropped",
        condition=C.DRIVE_DROPPED,
        action=SafetyAction.ESTOP,
        cause=Cause.DRIVE,
        description="the drive switched off without a request",
        clears=ON_TWO_STEP_RESET,
        contract_outcome="emergency",
    ),
    Check(
        name="program_error",
        condition=C.PROGRAM_ERROR,
        action=SafetyAction.ESTOP,
        cause=Cause.PROGRAM,
        description="the program raised an error",
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
        description="the arm moves although its brakes should hold it",
        clears=ON_RESTART,
        contract_outcome="emergency",
    ),
)
RESET_HELD = Check(
    name="reset_held",
    condition=C.RESET,
    action=SafetyAction.HOLD,
    cause=Cause.OPERATOR,
    description="after a reset the robot holds until a person resumes",
    clears=ON_RESUME,
)
"""The state after a two-step reset, with the severity of a HOLD."""

HEADER = """# The supervisor

The supervisor reacts to faults of the robot, the sensors, the filter, the control loop and the commander. In every tick
`Supervisor.update(now, flags)` maps the detected conditions to one decision: that of the strongest check that has
tripped. This page is generated from the table of checks
(`python -m dualbrain.safety.supervisor.checks > docs/reference/safety/supervisor.md`). The tests in
`tests/safety/supervisor/test_supervisor.py` cover all combinations.

Actions by severity: NONE < WARN < SLOW (the nominal control is scaled) < HOVER (zero through the filter, which may
still move the arm away from obstacles) < HOLD (monitored standstill, category 2) < CONTROLLED_STOP (the arm brakes,
then the drive is switched off, category 1) < ESTOP (drive off at once, category 0) < LOCKOUT (only a restart ends it).
The categories are those of IEC 60204-1 by name only; **nothing here is certified**.

- A condition must be present for `after` before its check trips. Gaps shorter than `release` do not interrupt it
  (anti-chatter).
- An ESTOP is latched. It clears in steps: the condition goes away, a *new* press of reset leads to HOLD, and `resume`
  ends the HOLD. A reset button that has been held since before has no effect.
- A CONTROLLED_STOP leaves the drive off until its condition is gone and the next contract begins. If the control loop
  itself is late, the drive does not wait for the filter to brake: it is switched off at once and brakes by itself.
- A drive is switched on only while the arm is at rest, and the control is zero until the drive reports that it is on.
- A check that ends a contract ends it with the outcome in the table. Only ESTOP and LOCKOUT need a person.
- After an unexpected contact the arm yields to the force through the filter before it stops
  ([Contact force](contact_force.md)).
- Thresholds are in `safety/supervisor/state_monitor.py`, `safety/supervisor/timing.py`,
  `safety/supervisor/enforcement.py` and `safety/contact_force/limits.py`."""


def render_markdown() -> str:
    """Markdown text of docs/reference/safety/supervisor.md."""
    head = ["| check | condition | after | action | cause | contract | clears |", "|---|---|---|---|---|---|---|"]
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
    ending = check.contract_outcome.replace("_", " ") or "continues"
    action = f"{check.action.name}, drive off at once" if check.immediate_drive_off else check.action.name
    return (
        f"| `{check.name}` | {check.description} | {after} | {action} | {check.cause.value} | {ending} | "
        f"{gone[check.clears]} |"
    )


if __name__ == "__main__":
    sys.stdout.write(render_markdown())
