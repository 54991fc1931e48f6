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


class Check(msgspec.Struct, frozen=True):
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
    Check("state_missed", C.STATE_MISSED, SafetyAction.WARN, Cause.TIMING, "joint states were lost on the way",
          release=1.0),
    Check("state_repeated", C.STATE_REPEATED, SafetyAction.WARN, Cause.TIMING, "the same joint state came again"),
    Check("tick_overrun", C.TICK_OVERRUN, SafetyAction.WARN, Cause.TIMING, "a control tick took longer than its period",
          release=1.0),
    Check("command_late", C.COMMAND_LATE, SafetyAction.WARN, Cause.TIMING, "a command left late in its period", release=1.0),
    Check("frames_refused", C.FRAMES_REFUSED, SafetyAction.WARN, Cause.COMMANDER,
          "a message was refused: form, signature, order", release=0.5),
    Check("infeasible_briefly", C.INFEASIBLE, SafetyAction.WARN, Cause.FILTER,
          "no control meets all rows; the filter brakes"),
    Check("filter_stopped_briefly", C.FILTER_STOPPED | C.FILTER_FAULT, SafetyAction.WARN, Cause.FILTER,
          "the filter has stopped or cannot certify; it brakes"),
    Check("speed_stage", C.SPEED_STAGE, SafetyAction.SLOW, Cause.OPERATOR, "a person has chosen a lower speed",
          release=0.0),
    Check("scene_old", C.SCENE_OLD, SafetyAction.SLOW, Cause.SENSING, "the scene is older than a few looks", release=0.1),
    Check("ticks_overrun", C.TICKS_OVERRUN, SafetyAction.SLOW, Cause.TIMING,
          "many control ticks of the last second were late", release=1.0),
    Check("paused", C.PAUSE, SafetyAction.HOVER, Cause.OPERATOR, "a person has paused the contract", release=0.0),
    Check("infeasible", C.INFEASIBLE, SafetyAction.HOVER, Cause.FILTER, "no safe control for 50 ms", after=0.05,
          release=0.1, contract_outcome="taken_over"),
    Check("scene_stale", C.SCENE_STALE, SafetyAction.HOLD, Cause.SENSING, "moving things were seen too long ago",
          after=0.05, release=0.2, contract_outcome="stopped"),
    Check("scene_implausible", C.SCENE_IMPLAUSIBLE, SafetyAction.HOLD, Cause.SENSING,
          "the scene holds numbers that cannot be, or is stamped in the future", release=0.2, contract_outcome="stopped"),
    Check("scene_frozen", C.SCENE_FROZEN, SafetyAction.HOLD, Cause.SENSING,
          "a camera tells the same picture again and again, equal to the bit and stamped anew", release=0.2,
          contract_outcome="stopped"),
    Check("heartbeat_lost", C.HEARTBEAT_LOST, SafetyAction.HOLD, Cause.COMMANDER, "the commander has gone silent",
          release=0.1, contract_outcome="stopped"),
    Check("link_lost", C.LINK_LOST, SafetyAction.HOLD, Cause.COMMANDER, "the commander's connection is gone", release=0.1,
          contract_outcome="stopped"),
    Check("flood", C.FLOOD, SafetyAction.HOLD, Cause.COMMANDER, "the commander sends more than it may", release=0.5,
          contract_outcome="stopped"),
    Check("abort", C.ABORT, SafetyAction.HOLD, Cause.OPERATOR, "a person has ended the contract", release=0.2,
          contract_outcome="aborted"),
    Check("takeover", C.TAKEOVER, SafetyAction.HOLD, Cause.OPERATOR, "a person has taken the robot over", release=0.2,
          contract_outcome="handed_over"),
    Check("state_stale", C.STATE_STALE, SafetyAction.CONTROLLED_STOP, Cause.SENSING, "the joint state is too old",
          release=0.5, clears=ON_CONTINUE, contract_outcome="stopped"),
    Check("state_implausible", C.STATE_IMPLAUSIBLE, SafetyAction.CONTROLLED_STOP, Cause.SENSING,
          "the joint state is not finite, jumps, or lies far outside the joints' range", release=0.5,
          clears=ON_CONTINUE, contract_outcome="stopped"),
    Check("sources_disagree", C.SOURCES_DISAGREE, SafetyAction.CONTROLLED_STOP, Cause.SENSING,
          "measured positions and measured velocities do not tell the same motion", release=0.5, clears=ON_CONTINUE,
          contract_outcome="stopped"),
    Check("tracking_off", C.TRACKING_OFF, SafetyAction.CONTROLLED_STOP, Cause.DRIVE,
          "the arm is not where its commands led it", release=0.5, clears=ON_CONTINUE, contract_outcome="stopped"),
    Check("filter_stopped", C.FILTER_STOPPED, SafetyAction.CONTROLLED_STOP, Cause.FILTER, "filter STOPPED for 50 ms",
          after=0.05, release=0.5, clears=ON_CONTINUE, contract_outcome="stopped"),
    Check("filter_fault", C.FILTER_FAULT, SafetyAction.CONTROLLED_STOP, Cause.FILTER,
          "filter FAULT for 50 ms: not even braking could be certified", after=0.05, release=0.5, clears=ON_CONTINUE,
          contract_outcome="stopped"),
    Check("control_bad", C.CONTROL_BAD, SafetyAction.CONTROLLED_STOP, Cause.FILTER,
          "the control is not finite, leaves the joints' box or answers another question; braking is written instead",
          release=0.5, clears=ON_CONTINUE, contract_outcome="stopped"),
    Check("tick_lost", C.TICK_LOST, SafetyAction.CONTROLLED_STOP, Cause.TIMING,
          "the control loop stood still for too long", release=0.5, clears=ON_CONTINUE, contract_outcome="stopped"),
    Check("clock_step", C.CLOCK_STEP, SafetyAction.CONTROLLED_STOP, Cause.TIMING, "the clock jumped or ran backward",
          release=0.5, clears=ON_CONTINUE, contract_outcome="stopped"),
    Check("interrupted", C.INTERRUPT, SafetyAction.CONTROLLED_STOP, Cause.OPERATOR, "a person has interrupted the program",
          release=0.5, clears=ON_CONTINUE, contract_outcome="aborted"),
    Check("loop_behind", C.LOOP_BEHIND, SafetyAction.CONTROLLED_STOP, Cause.TIMING,
          "the control loop falls behind the robot: commands stay in force too long", release=0.5, clears=ON_CONTINUE,
          contract_outcome="stopped", immediate_drive_off=True),
    Check("state_lost", C.STATE_LOST, SafetyAction.ESTOP, Cause.SENSING,
          "no joint state for so long that braking is blind", clears=ON_TWO_STEP_RESET, contract_outcome="emergency"),
    Check("tracking_lost", C.TRACKING_LOST, SafetyAction.ESTOP, Cause.DRIVE,
          "the drive does not follow its commands at all", clears=ON_TWO_STEP_RESET, contract_outcome="emergency"),
    Check("overspeed", C.OVERSPEED, SafetyAction.ESTOP, Cause.DRIVE, "a joint is faster than its limit", clears=ON_TWO_STEP_RESET,
          contract_outcome="emergency"),
    Check("drift", C.DRIFT, SafetyAction.ESTOP, Cause.DRIVE, "the arm moves in a monitored standstill", clears=ON_TWO_STEP_RESET,
          contract_outcome="emergency"),
    Check("stop_overdue", C.STOP_OVERDUE, SafetyAction.ESTOP, Cause.DRIVE, "a stop was ordered and the arm still moves",
          clears=ON_TWO_STEP_RESET, contract_outcome="emergency"),
    Check("drive_dropped", C.DRIVE_DROPPED, SafetyAction.ESTOP, Cause.DRIVE, "the drive went off unasked", clears=ON_TWO_STEP_RESET,
          contract_outcome="emergency"),
    Check("program_error", C.PROGRAM_ERROR, SafetyAction.ESTOP, Cause.PROGRAM, "the program broke", clears=ON_TWO_STEP_RESET,
          contract_outcome="stopped"),
    Check("estop", C.ESTOP, SafetyAction.ESTOP, Cause.OPERATOR, "the emergency stop was pressed", clears=ON_TWO_STEP_RESET,
          contract_outcome="emergency"),
    Check("estop_disagrees", C.ESTOP_DISAGREE, SafetyAction.LOCKOUT, Cause.OPERATOR,
          "the two channels of the emergency stop contradict each other", after=0.5, clears=ON_RESTART,
          contract_outcome="emergency"),
    Check("falling", C.FALLING, SafetyAction.LOCKOUT, Cause.DRIVE, "the arm moves though its brakes should hold it",
          clears=ON_RESTART, contract_outcome="emergency"),
)  # fmt: skip
RESET_HELD = Check(
    "reset_held", C.RESET, SafetyAction.HOLD, Cause.OPERATOR, "after a reset the robot stands until somebody resumes",
    clears=ON_RESUME,
)  # fmt: skip
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
        ON_CONTINUE: f"gone for {check.release * 1e3:.0f} ms, and the next contract", ON_RESUME: "resume",
        ON_TWO_STEP_RESET: "two-step reset", ON_RESTART: "restart",
    }  # fmt: skip
    ending = check.contract_outcome.replace("_", " ") or "goes on"
    action = f"{check.action.name}, drive off at once" if check.immediate_drive_off else check.action.name
    return (
        f"| `{check.name}` | {check.description} | {after} | {action} | {check.cause.value} | {ending} | "
        f"{gone[check.clears]} |"
    )


if __name__ == "__main__":
    sys.stdout.write(render_markdown())
