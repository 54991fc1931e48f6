"""The local layer: an accepted contract becomes motion, action by action, on top of the control tick.

Nothing from a planner is believed here; a contract arrives as the gate accepted it. However it ends, the arm brakes to
rest through the filter, and the outcome is the robot's own verdict.
"""

from __future__ import annotations

import traceback

from dualbrain.contracts.contract import Action, Contract
from dualbrain.control.control_loop import IDLE_ACTION, ControlLoop
from dualbrain.records import ActionResult, Outcome, OutcomeClass
from dualbrain.safety.supervisor.actions import Cause, SafetyAction
from dualbrain.safety.supervisor.checks import CHECKS
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.skills.registry import SkillExecution
from dualbrain.skills.skill import HeldObject, SkillResult, SkillStatus

MAX_ACTION_TIME = 300.0
"""An action that has not ended by itself after this long [s] is taken over: people may come by again and again."""
CLEARING_TIMEOUT = 0.8
"""A new contract waits this long [s] for the conditions of an earlier stop to be gone."""
INTERRUPTED_REASON = "interrupted by a person"
"""How an action ends when a person wants the robot to stop."""
OPERATOR_OUTCOMES: dict[str, OutcomeClass] = {"paused": "paused", "speed_stage": "slowed"}
"""What a person's hand makes of a contract that was finished all the same."""
STOP_OUTCOMES = ("aborted", "stopped", "handed_over", "emergency")
"""Outcomes that a fault on the way to rest does not outrank."""


class ContractExecutor(ControlLoop):
    """Carries contracts out."""

    def execute(self, contract: Contract) -> Outcome:
        """Carry out `contract`; the outcome is the robot's own verdict, never simulator truth.

        However it ends, the arm brakes to rest through the filter; what the drive does is the supervisor's order. What
        raises in here is a fault: the drive goes off at once, and the outcome says what it was.
        """
        first = len(self.log.trace)
        self._checks_during_contract.clear()
        self._clear_stop()
        results: list[ActionResult] = []
        kind: OutcomeClass = "succeeded"
        for index, action in enumerate(contract.action_sequence):
            result, kind = (
                self._execute_action(action, index) if kind == "succeeded" else (not_run_result(action), kind)
            )
            results.append(result)
        kind, fault = self._come_to_rest(kind)
        if kind == "succeeded" and all(action.skill == "decline" for action in contract.action_sequence):
            kind = "declined"
        elif kind == "succeeded":
            kind = self._completed_outcome()
        bad = next((result for result in results if result.status not in ("done", "not_run")), results[-1])
        return self.log.outcome(kind, fault or bad.reason, first, tuple(results))

    def _completed_outcome(self) -> OutcomeClass:
        """A contract that went well, as a person's hand has it."""
        for name, kind in OPERATOR_OUTCOMES.items():
            if name in self._checks_during_contract:
                return kind
        return "succeeded"

    def _clear_stop(self) -> None:
        """A new contract leads out of a stop whose condition is gone; not out of what needs a person."""
        for tick in range(round(CLEARING_TIMEOUT / self.robot_model.period)):
            if not self.safety_controller.contract_outcome:
                return
            if tick % 2 == 0:  # pressed anew, as it counts only once the condition is gone
                self.safety_controller.report(Condition.CONTINUE)
            self._rest_tick("continue", IDLE_ACTION)

    def _come_to_rest(self, kind: OutcomeClass) -> tuple[OutcomeClass, str]:
        """Come to rest and end all permits; a fault on the way outranks every `kind` that is not a stop already.

        What did not go well may have left the hand around a thing: contacts that there still are stay permitted.
        """
        try:
            self.hold(self.config.settle_time, "settle")
            touches = () if kind == "succeeded" else self._residual_contacts.combine(self._touches)
            self._residual_contacts.retain(self._phase, touches, self.state, self.scene)
            self._touches = ()
            self._update_permits()
            self._register_late_grasp()
        except Exception as error:
            why = self._stop_on_fault(error).reason
            return (kind, "") if kind in STOP_OUTCOMES else ("stopped", why)
        return kind, ""

    # --- one action ---------------------------------------------------------------------------------------------

    def _execute_action(self, action: Action, index: int) -> tuple[ActionResult, OutcomeClass]:
        started, first = self.state.stamp, len(self.log.trace)
        self.log.note(started, "action", f"{action.skill} {format_parameters(action)}", index=index)
        self._roles = action_roles(action, self.controller.holding)
        self._skill = action.skill
        try:
            self._update_obstacles()
            ending = self._run_skill(SkillExecution(self.controller, action.skill, action.params), index)
        except Exception as error:
            ending = self._stop_on_fault(error)
        self.log.note(self.state.stamp, "action", f"{action.skill}: {ending.reason}", status=ending.status.value)
        kinds: dict[SkillStatus, OutcomeClass] = {
            SkillStatus.DONE: "succeeded",
            SkillStatus.FAILED: "failed",
            SkillStatus.TAKEN_OVER: "taken_over",
            SkillStatus.RUNNING: self._interrupted_outcome(ending),
        }
        status = "stopped" if ending.status is SkillStatus.RUNNING else ending.status.value
        kind = kinds[ending.status]
        Delta = self.log.mean_delta(first)
        return ActionResult(
            skill=action.skill,
            status=status,
            reason=ending.reason,
            started=started,
            ended=self.state.stamp,
            Delta=Delta,
        ), kind

    def _interrupted_outcome(self, ending: SkillResult) -> OutcomeClass:
        """The outcome of an action that neither ended by itself nor was taken over."""
        return (
            "aborted" if ending.reason == INTERRUPTED_REASON else self.safety_controller.contract_outcome or "stopped"
        )

    def _run_skill(self, running: SkillExecution, index: int) -> SkillResult:
        """Tick until the story ends or is ended; an end by the supervisor's order has status RUNNING."""
        end = self.state.stamp + MAX_ACTION_TIME
        while not self.interrupted():
            if why := self._supervisor_result():
                return why
            if (
                self.safety_controller.decision.action >= SafetyAction.HOVER
            ):  # paused: the story waits, and so does its patience
                self._rest_tick("paused", index)
                self._paused_time, end = self._paused_time + self.robot_model.period, end + self.robot_model.period
                continue
            nominal = running.nominal(self._observation())
            self._mark_part("skills")
            if isinstance(nominal, SkillResult):
                return nominal
            if self.state.stamp > end:
                return SkillResult(SkillStatus.TAKEN_OVER, f"{self._phase}: not done after {MAX_ACTION_TIME:.0f} s")
            self._last_result = self._rest_tick("think", index) if nominal is None else self._tick(nominal, index)
            if self.safety_controller.scale_applied < 1.0:
                self._paused_time += (1.0 - max(0.0, self.safety_controller.scale_applied)) * self.robot_model.period
        self.log.note(self.state.stamp, "takeover", "interrupted by a person: braking to rest")
        return SkillResult(SkillStatus.RUNNING, INTERRUPTED_REASON)

    def _supervisor_result(self) -> SkillResult | None:
        """How the supervisor ends the contract, if it does."""
        ending = self.safety_controller.contract_outcome
        if not ending:
            return None
        check = next(
            check
            for check in reversed(CHECKS)
            if check.name in self.safety_controller.supervisor.tripped_checks and check.contract_outcome
        )
        detail = f": {self._last_result.explain()}" if check.cause is Cause.FILTER and self._last_result else ""
        status = SkillStatus.TAKEN_OVER if ending == "taken_over" else SkillStatus.RUNNING
        return SkillResult(status, f"{check.description}{detail}")

    def _stop_on_fault(self, error: Exception) -> SkillResult:
        """A fault of the program or of its inputs: the drive goes off at once, and what it was is noted."""
        self.robot.stop()
        self._drive_on = False
        self.safety_controller.report(Condition.PROGRAM_ERROR)
        why = f"{type(error).__name__}: {error}"
        self.log.note(self.state.stamp, "fault", why, traceback=traceback.format_exc())
        return SkillResult(SkillStatus.RUNNING, why)


def action_roles(action: Action, holding: HeldObject | None) -> dict[str, str | None]:
    """What the action is about: its target and its destination, by name."""
    params = action.params
    target = params.get("object") or params.get("target") or (holding.name if holding else None)
    destination = params.get("destination")
    return {"target": str(target) if target else None, "destination": str(destination) if destination else None}


def format_parameters(action: Action) -> str:
    """Its parameters, for the log."""
    return ", ".join(
        f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}" for name, value in action.params.items()
    )


def not_run_result(action: Action) -> ActionResult:
    """What is said of an action that never began."""
    return ActionResult(
        skill=action.skill,
        status="not_run",
        reason="an earlier action did not succeed",
        started=0.0,
        ended=0.0,
        Delta=0.0,
    )
