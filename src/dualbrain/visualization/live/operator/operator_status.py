"""State of the robot in the operator's words: one of five states, the reason, and the operator's next action."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum

from dualbrain.control.recording.trace import DEAD_BAND
from dualbrain.safety.supervisor.actions import SafetyAction
from dualbrain.safety.supervisor.checks import CHECKS, RESET_HELD, Check, ClearPolicy

GIVING_WAY_TIME_S = 0.8
"""Time [s] for which the state GIVING WAY stays after its last cause, so that the word does not flicker."""

PHASE_WORDS = {
    "planning": "The planner prepares a contract",
    "approach": "The arm moves to the object",
    "descend": "The arm moves down to the object",
    "close": "The fingers close",
    "lift": "The arm lifts the object",
    "rise": "The arm moves up",
    "carry": "The arm carries the object to its destination",
    "lower": "The arm lowers the object",
    "open": "The fingers open",
    "retreat": "The arm moves away from the object",
    "push": "The arm pushes the object",
    "shut": "The fingers close before a push",
    "return": "The arm moves to its home posture",
    "hold": "The arm holds its position",
    "stop": "The base comes to rest",
    "drive": "The base drives",
    "turn": "The base turns",
    "settle": "The contract has ended, and the arm comes to rest",
}
"""Sentences about the phases of the skills; another phase is shown by its own name."""
WAITING_PHASES = {
    "wait": "The arm waits until a person has left its way.",
    "yield": "The arm moves out of the way of a person, and waits there.",
}
"""Sentences about the phases in which a skill gives way to a person."""


class OperatorState(Enum):
    """The five states that a person must recognize from a distance."""

    MOVING = "MOVING"
    GIVING_WAY = "GIVING WAY TO A PERSON"
    HOLDING = "HOLDING"
    STOPPED = "STOPPED"
    EMERGENCY_STOP = "EMERGENCY STOP"


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterLimit:
    """The pair that limits the motion most: a `part` of the robot, the `other` body, and their `clearance` [m]."""

    part: str
    other: str
    clearance: float
    is_person: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Situation:
    """The facts of one tick behind the words.

    `action` and `check` are those of the supervisor, `filter_status` the name of a `FilterStatus`. `speed_share` is the
    speed of the filtered control relative to the nominal one. `result` is the outcome of a finished run, "" before.
    """

    t: float = 0.0
    action: str = "NONE"
    check: str = ""
    filter_status: str = "SAFE"
    in_contract: bool = False
    phase: str = ""
    delta: float = 0.0
    speed_share: float = 1.0
    limit: FilterLimit | None = None
    result: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class OperatorStatus:
    """The words: the state, the reason in one sentence, the operator's next action, and the steps of a reset."""

    state: OperatorState
    reason: str
    next_action: str
    steps: tuple[str, ...] = field(default=())


STARTING = OperatorStatus(
    state=OperatorState.HOLDING, reason="The program starts.", next_action="Wait for the first contract."
)
"""The status before the first tick."""
RESET_STEPS = (
    "When the danger is over: open “operator”, enter the code that the terminal shows, and press “1. release the "
    "emergency stop”.",
    "Press “2. reset, into hold”. The arm holds still until you press “resume” there.",
)
AFTER_RUN = "The run has ended, and with it the drive is off. Find and remove the cause before the next instruction."
FAULT_RESET_STEPS = ("Find and remove the cause.", RESET_STEPS[1])
"""Steps of the reset after the emergency-stop button, and after a fault that led to an emergency stop.

A run whose contract ends so ends too; its page then shows `AFTER_RUN`.
"""

RESUME = "To continue, open “operator” and press “resume”."
MOVE_AWAY = "Move away from the arm: it continues by itself."

_CHECKS: dict[str, Check] = {check.name: check for check in (*CHECKS, RESET_HELD)}
_NEXT_BY_CHECK = {
    "paused": RESUME,
    "takeover": "Guide the arm by hand; open “operator” and press “hand back” when you are done.",
    "abort": "Give a new instruction.",
    "estop_disagrees": "Repair the wiring of the emergency stop, then start the program again.",
    "falling": "Keep away from the arm, check its brakes, then start the program again.",
}
_NEXT_BY_POLICY = {
    ClearPolicy.ON_CONTINUE: "Remove the cause. Then open “operator” and press “resume”, or give a new instruction.",
    ClearPolicy.ON_RESUME: RESUME,
    ClearPolicy.ON_TWO_STEP_RESET: "Reset in two steps:",
    ClearPolicy.ON_RESTART: "Start the program again; nothing else ends this state.",
}


class StatusTracker:
    """Status of consecutive situations; GIVING WAY stays for `GIVING_WAY_TIME_S` after its last cause."""

    def __init__(self) -> None:
        """Start before the first tick."""
        self._last_way: tuple[float, OperatorStatus] | None = None

    def update(self, situation: Situation) -> OperatorStatus:
        """The status in `situation`."""
        status = describe_situation(situation)
        if status.state is OperatorState.GIVING_WAY:
            self._last_way = (situation.t, status)
        elif status.state is OperatorState.MOVING and self._last_way is not None:
            since, earlier = self._last_way
            if 0.0 <= situation.t - since < GIVING_WAY_TIME_S:
                return earlier
        return status


def describe_situation(now: Situation) -> OperatorStatus:
    """The status without regard to earlier situations; the supervisor's decision is before everything else."""
    action = SafetyAction[now.action] if now.action in SafetyAction.__members__ else SafetyAction.NONE
    if action >= SafetyAction.HOVER:
        status = _supervised(action, _CHECKS.get(now.check))
        return replace(status, next_action=AFTER_RUN, steps=()) if now.result else status
    if now.result:
        return OperatorStatus(
            state=OperatorState.STOPPED,
            reason=f"The run has ended: {now.result}",
            next_action="Give a new instruction.",
        )
    if now.filter_status in ("STOPPED", "FAULT"):
        return OperatorStatus(
            state=OperatorState.STOPPED,
            reason="The safety filter cannot confirm a safe motion, so the arm brakes.",
            next_action="Keep clear of the arm; it continues by itself when a safe motion exists.",
        )
    if not now.in_contract:
        return _idle(now.phase)
    return _moving(now)


def _supervised(action: SafetyAction, check: Check | None) -> OperatorStatus:
    if action >= SafetyAction.ESTOP:
        state = OperatorState.EMERGENCY_STOP
    else:
        state = OperatorState.STOPPED if action is SafetyAction.CONTROLLED_STOP else OperatorState.HOLDING
    if check is None:
        return OperatorStatus(state=state, reason="The supervisor ordered it.", next_action="See the details below.")
    steps: tuple[str, ...] = ()
    if check.clears is ClearPolicy.ON_TWO_STEP_RESET:
        steps = RESET_STEPS if check.name == "estop" else FAULT_RESET_STEPS
    return OperatorStatus(state=state, reason=_sentence(check.description), next_action=_next_of(check), steps=steps)


def _next_of(check: Check) -> str:
    if check.clears in _NEXT_BY_POLICY:
        return _NEXT_BY_CHECK.get(check.name, _NEXT_BY_POLICY[check.clears])
    ended = "The contract has ended: remove the cause, then give a new instruction."
    return _NEXT_BY_CHECK.get(check.name, ended if check.contract_outcome else "It continues by itself.")


def _idle(phase: str) -> OperatorStatus:
    if phase in ("planning", "settle"):
        return OperatorStatus(
            state=OperatorState.HOLDING, reason=f"{PHASE_WORDS[phase]}.", next_action="Keep clear: the arm moves next."
        )
    return OperatorStatus(
        state=OperatorState.HOLDING, reason="No contract is being carried out.", next_action="Give an instruction."
    )


def _moving(now: Situation) -> OperatorStatus:
    limit, changed = now.limit, now.delta > DEAD_BAND
    if now.phase in WAITING_PHASES:
        return OperatorStatus(
            state=OperatorState.GIVING_WAY,
            reason=WAITING_PHASES[now.phase],
            next_action=MOVE_AWAY,
        )
    if changed and limit is not None and limit.is_person:
        return OperatorStatus(
            state=OperatorState.GIVING_WAY,
            reason=f"{_pair(limit)}, so the safety filter {_change(now.speed_share)}.",
            next_action=MOVE_AWAY,
        )
    words = PHASE_WORDS.get(now.phase, f"The robot carries out the step “{now.phase}”")
    cause = f"; {_pair(limit).lower()}, so the safety filter {_change(now.speed_share)}" if changed and limit else ""
    return OperatorStatus(
        state=OperatorState.MOVING, reason=f"{words}{cause}.", next_action="Keep clear of the arm, or stop it."
    )


def _pair(limit: FilterLimit) -> str:
    body = f"the person ({limit.other})" if limit.is_person else limit.other
    distance = f"{max(0.0, limit.clearance) * 1e3:.0f} mm from the safety margin of"
    return f"The robot's {limit.part} is {distance} {body}"


def _change(speed_share: float) -> str:
    if speed_share < 0.02:
        return "holds the arm still"
    return f"slows the arm to {100 * speed_share:.0f} %" if speed_share < 0.98 else "changes the direction of the arm"


def _sentence(description: str) -> str:
    return f"{description[:1].upper()}{description[1:]}."
