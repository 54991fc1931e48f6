"""Execution of accepted contracts: each action becomes a skill whose nominal control runs through the control loop.

A contract arrives as the gate accepted it; nothing else from a planner is used. However a contract ends, the arm brakes
to rest through the filter, and the outcome is the robot's own verdict.
"""

from __future__ import annotations

import traceback

import msgspec
import numpy as np

from dualbrain.contracts.contract import Action, Contract
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.verdict import Rejected
from dualbrain.control.control_loop import IDLE_ACTION, ControlLoop
from dualbrain.control.executor import Grants
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.grip_profile import grip_profiles
from dualbrain.grounding.envelope.scene_rules import scene_rules
from dualbrain.records import ActionResult, FailureCause, MarginShortfall, Outcome, OutcomeClass, Scene
from dualbrain.robots.interface import RobotState
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.filter import FilterResult
from dualbrain.safety.supervisor.actions import Cause, SafetyAction
from dualbrain.safety.supervisor.checks import CHECKS, Check
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.skills.registry import SkillExecution, skill_registry
from dualbrain.skills.skill import HeldObject, SkillResult, SkillStatus

MAX_ACTION_TIME = 300.0
"""Time [s] after which an action that has not ended is taken over, for example because a person keeps passing."""
CLEARING_TIMEOUT = 0.8
"""Time [s] that a new contract waits for the conditions of an earlier stop to clear."""
TIME_LIMIT_REASON = "out of time"
"""Beginning of the reason of a contract that had not ended at the time limit."""
INTERRUPTED_REASON = "interrupted by a person"
"""Reason of an action that ended because a person wants the robot to stop."""
OPERATOR_OUTCOMES: dict[str, OutcomeClass] = {"paused": "paused", "speed_stage": "slowed"}
"""Outcome of a completed contract during which the operator paused or slowed the robot, by supervisor check."""
STOP_OUTCOMES = ("aborted", "stopped", "handed_over", "emergency")
"""Outcomes that an error on the way to rest does not replace."""


class ContractExecutor:
    """Executes contracts on a control loop in this process; implements `Executor`."""

    def __init__(self, loop: ControlLoop, *, time_limit: float = float("inf")) -> None:
        """Execute on `loop`. A contract that `loop` interrupts after its time is `time_limit` [s] has failed."""
        self.loop, self.time_limit = loop, time_limit
        self._last_result: FilterResult | None = None

    @property
    def robot_model(self) -> RobotModel:
        """The robot."""
        return self.loop.robot_model

    @property
    def scene(self) -> Scene:
        """The newest perceived scene."""
        return self.loop.scene

    @property
    def state(self) -> RobotState:
        """The newest joint state."""
        return self.loop.state

    @property
    def held_object(self) -> str | None:
        """The name of the object in the gripper, None if the gripper is empty."""
        return self.loop.held_object

    @property
    def log(self) -> FlightLog:
        """Events, binding barriers and the trace of the run."""
        return self.loop.log

    def interrupted(self) -> bool:
        """Whether a person wants the robot to stop, or the time limit is over."""
        return self.loop.inputs.interrupted()

    def hold(self, duration: float, phase: str = "hold") -> None:
        """Hold position for `duration` [s]; the filter may still give way to a moving obstacle."""
        self.loop.hold(duration, phase)

    def gate(self, grants: Grants) -> Gate:
        """The three-stage gate; its envelope rules use the scene and the gripper at the time of the check."""
        return Gate(skill_registry(self.robot_model), grants, (self._check_scene_rules,))

    def _check_scene_rules(self, contract: Contract) -> Rejected | None:
        rejections = (rule(contract) for rule in scene_rules(self.scene, self.loop.controller))
        return next((rejection for rejection in rejections if rejection), None)

    def execute(self, contract: Contract) -> Outcome:
        """Execute `contract`; the outcome is the robot's own verdict, never simulator truth.

        However the contract ends, the arm brakes to rest through the filter; the supervisor decides about the drive. An
        exception in here is a programming error: the drive goes off at once, and the outcome names the error.
        """
        first, held = len(self.log.trace), self.held_object
        self.loop.begin_contract()
        self._clear_stop()
        results: list[ActionResult] = []
        kind: OutcomeClass = "succeeded"
        for index, action in enumerate(contract.action_sequence):
            if kind == "succeeded":
                result, kind = self._execute_action(action, index)
            else:
                result = not_run_result(action)
            results.append(result)
        kind, error = self._come_to_rest(kind, results)
        if kind == "succeeded":
            declined = all(action.skill == "decline" for action in contract.action_sequence)
            kind = "declined" if declined else self._completed_outcome()
        bad = next((result for result in results if result.status not in ("done", "not_run")), results[-1])
        reason = error or bad.reason
        if kind == "aborted" and self._is_out_of_time():
            kind, reason = "failed", f"{TIME_LIMIT_REASON}, {self.time_limit:.0f} s"
        outcome = self.log.outcome(kind, reason, first, tuple(results))
        return msgspec.structs.replace(
            outcome,
            margin_shortfalls=self._margin_shortfalls(first),
            grips=grip_profiles(self.log.trace, first, contract, held),
        )

    def _margin_shortfalls(self, first: int) -> tuple[MarginShortfall, ...]:
        """The intervals with h < 0 during the actions of the segment that began at tick `first`."""
        chosen = np.flatnonzero(self.log.trace["action"][first:] >= 0) + first
        if not len(chosen):
            return ()
        t = self.log.trace["t"]
        return self.loop.margin_monitor.between(float(t[chosen[0]]), float(t[chosen[-1]]))

    def _is_out_of_time(self) -> bool:
        return self.state.stamp >= self.time_limit

    def _completed_outcome(self) -> OutcomeClass:
        """The outcome of a completed contract; the operator may have paused or slowed the robot."""
        for name, kind in OPERATOR_OUTCOMES.items():
            if name in self.loop.checks_during_contract:
                return kind
        return "succeeded"

    def _clear_stop(self) -> None:
        """Leave a stop whose condition has cleared; a stop that needs a person remains."""
        for tick in range(round(CLEARING_TIMEOUT / self.robot_model.period)):
            if not self.loop.safety_controller.contract_outcome:
                return
            if tick % 2 == 0:  # reported repeatedly, because it counts only once the condition has cleared
                self.loop.safety_controller.report(Condition.CONTINUE)
            self.loop.rest_tick("continue", IDLE_ACTION)

    def _come_to_rest(self, kind: OutcomeClass, results: list[ActionResult]) -> tuple[OutcomeClass, str]:
        """Come to rest and withdraw all permits; the outcome, and its reason if it changed on the way.

        An error replaces an outcome that is not already a stop; a stop or a change of the load replaces a success.
        """
        reason = ""
        try:
            self.hold(self.loop.config.settle_time, "settle")
            if kind == "succeeded":
                kind, reason = self._settled_outcome(results)
            self.loop.end_contract(succeeded=kind == "succeeded")
        except Exception as error:
            fault = self._stop_on_fault(error).reason
            return (kind, reason) if kind in STOP_OUTCOMES else ("stopped", fault)
        return kind, reason

    def _settled_outcome(self, results: list[ActionResult]) -> tuple[OutcomeClass, str]:
        """The outcome after settling of a contract whose actions are done, and the reason if it is no success.

        A change of the load is the failure of the last action.
        """
        if stop := self._supervisor_result():
            return self.loop.safety_controller.contract_outcome or "stopped", stop.reason
        if self.interrupted():
            return "aborted", INTERRUPTED_REASON
        if event := self.loop.controller.take_load_event():
            reason = f"settle: {event.describe()}"
            results[-1] = msgspec.structs.replace(results[-1], status="failed", reason=reason, cause=event.cause)
            return "failed", reason
        return "succeeded", ""

    # --- one action -----------------------------------------------------------------------------------------------

    def _execute_action(self, action: Action, index: int) -> tuple[ActionResult, OutcomeClass]:
        started, first = self.state.stamp, len(self.log.trace)
        self.log.note(started, "action", f"{action.skill} {format_parameters(action)}", index=index)
        self.loop.begin_action(action.skill, action_roles(action, self.loop.controller.holding))
        try:
            self.loop.update_obstacles()
            ending = self._run_skill(SkillExecution(self.loop.controller, action.skill, action.params), index)
        except Exception as error:
            ending = self._stop_on_fault(error)
        self.loop.controller.check_holding()
        self.log.note(self.state.stamp, "action", f"{action.skill}: {ending.reason}", status=ending.status.value)
        kinds: dict[SkillStatus, OutcomeClass] = {
            SkillStatus.DONE: "succeeded",
            SkillStatus.FAILED: "failed",
            SkillStatus.TAKEN_OVER: "taken_over",
            SkillStatus.RUNNING: self._interrupted_outcome(ending),
        }
        result = ActionResult(
            skill=action.skill,
            status="stopped" if ending.status is SkillStatus.RUNNING else ending.status.value,
            reason=ending.reason,
            started=started,
            ended=self.state.stamp,
            Delta=self.log.mean_delta(first),
            cause=ending.cause,
        )
        return result, kinds[ending.status]

    def _interrupted_outcome(self, ending: SkillResult) -> OutcomeClass:
        """The outcome of an action that neither ended by itself nor was taken over."""
        if ending.reason == INTERRUPTED_REASON:
            return "aborted"
        return self.loop.safety_controller.contract_outcome or "stopped"

    def _run_skill(self, execution: SkillExecution, index: int) -> SkillResult:
        """Tick until the skill ends or is ended; a skill that the supervisor ends has the status RUNNING."""
        loop, period = self.loop, self.robot_model.period
        deadline = self.state.stamp + MAX_ACTION_TIME
        while not self.interrupted():
            if result := self._supervisor_result():
                return result
            if loop.safety_controller.decision.action >= SafetyAction.HOVER:  # a pause stops the skill and its patience
                loop.rest_tick("paused", index)
                loop.add_paused_time(period)
                deadline += period
                continue
            nominal = execution.nominal(loop.observation())
            loop.observer.mark_part("skills")
            if isinstance(nominal, SkillResult):
                return nominal
            if self.state.stamp > deadline:
                return SkillResult(
                    SkillStatus.TAKEN_OVER,
                    f"{loop.phase}: not done after {MAX_ACTION_TIME:.0f} s",
                    FailureCause.NO_PROGRESS,
                )
            self._last_result = loop.rest_tick("think", index) if nominal is None else loop.tick(nominal, index)
            if loop.safety_controller.scale_applied < 1.0:
                loop.add_paused_time((1.0 - max(0.0, loop.safety_controller.scale_applied)) * period)
        self.log.note(self.state.stamp, "takeover", "interrupted by a person: braking to rest")
        return SkillResult(SkillStatus.RUNNING, INTERRUPTED_REASON)

    def _supervisor_result(self) -> SkillResult | None:
        """The result by which the supervisor ends the contract, None while it does not."""
        outcome = self.loop.safety_controller.contract_outcome
        if not outcome:
            return None
        tripped = self.loop.safety_controller.supervisor.tripped_checks
        check = next(one for one in reversed(CHECKS) if one.name in tripped and one.contract_outcome)
        detail = f": {explanation}" if (explanation := self._explain(check)) else ""
        status = SkillStatus.TAKEN_OVER if outcome == "taken_over" else SkillStatus.RUNNING
        return SkillResult(status, f"{check.description}{detail}")

    def _explain(self, check: Check) -> str:
        """What is known about the cause of a tripped check, beyond its description."""
        if check.condition is Condition.RECORDING_LOST:
            return self.loop.recording_failure
        if check.condition is Condition.UNEXPECTED_CONTACT and self.loop.safety_controller.contact is not None:
            return self.loop.safety_controller.contact.explain()
        if check.cause is Cause.FILTER and self._last_result:
            return self._last_result.explain(remedy=False)
        return ""

    def _stop_on_fault(self, error: Exception) -> SkillResult:
        """Switch the drive off at once after an exception, and record its type, text and traceback."""
        self.loop.stop_on_fault()
        reason = f"{type(error).__name__}: {error}"
        self.log.note(self.state.stamp, "fault", reason, traceback=traceback.format_exc())
        return SkillResult(SkillStatus.RUNNING, reason)


def action_roles(action: Action, holding: HeldObject | None) -> dict[str, str | None]:
    """Names of the objects of an action by role: its target and its destination."""
    params = action.params
    target = params.get("object") or params.get("target") or (holding.name if holding else None)
    destination = params.get("destination")
    return {"target": str(target) if target else None, "destination": str(destination) if destination else None}


def format_parameters(action: Action) -> str:
    """The parameters of an action, for the log."""
    return ", ".join(
        f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}" for name, value in action.params.items()
    )


def not_run_result(action: Action) -> ActionResult:
    """The result of an action that never began."""
    return ActionResult(
        skill=action.skill,
        status="not_run",
        reason="an earlier action did not succeed",
        started=0.0,
        ended=0.0,
        Delta=0.0,
    )
