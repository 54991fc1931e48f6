"""The local layer: an accepted contract becomes motion, action by action, on top of the control tick.

Nothing from a planner is believed here; a contract arrives as the gate accepted it. However it ends, the arm brakes to
rest through the filter, and the outcome is the robot's own verdict.
"""

from __future__ import annotations

import traceback

from dualbrain.contracts.contract import Action, Contract
from dualbrain.control.control_loop import IDLE, ControlTick
from dualbrain.records import ActionResult, Outcome, OutcomeClass
from dualbrain.safety.supervisor.actions import Cause, Rung
from dualbrain.safety.supervisor.checks import CHECKS
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.skills.registry import Running
from dualbrain.skills.skill import Ending, Holding, Status

LONGEST = 300.0
"""An action that has not ended by itself after this long [s] is taken over: people may come by again and again."""
CLEARING = 0.8
"""A new contract waits this long [s] for the conditions of an earlier stop to be gone."""
INTERRUPTED = "interrupted by a person"
"""How an action ends when a person wants the robot to stop."""
ATTENDED: dict[str, OutcomeClass] = {"paused": "paused", "speed_stage": "slowed"}
"""What a person's hand makes of a contract that was finished all the same."""
BROKEN_OFF = ("aborted", "stopped", "handed_over", "emergency")
"""Outcomes that a fault on the way to rest does not outrank."""


class LocalLayer(ControlTick):
    """Carries contracts out."""

    def run(self, contract: Contract) -> Outcome:
        """Carry out `contract`; the outcome is the robot's own verdict, never simulator truth.

        However it ends, the arm brakes to rest through the filter; what the drive does is the supervisor's order. What
        raises in here is a fault: the drive goes off at once, and the outcome says what it was.
        """
        first = len(self.log.trace)
        self._attended.clear()
        self._continue()
        results: list[ActionResult] = []
        kind: OutcomeClass = "succeeded"
        for index, action in enumerate(contract.action_sequence):
            result, kind = self._act(action, index) if kind == "succeeded" else (not_run(action), kind)
            results.append(result)
        kind, fault = self._settle(kind)
        if kind == "succeeded" and all(action.skill == "decline" for action in contract.action_sequence):
            kind = "declined"
        elif kind == "succeeded":
            kind = self._as_attended()
        bad = next((result for result in results if result.status not in ("done", "not_run")), results[-1])
        return self.log.outcome(kind, fault or bad.reason, first, tuple(results))

    def _as_attended(self) -> OutcomeClass:
        """A contract that went well, as a person's hand has it."""
        for name, kind in ATTENDED.items():
            if name in self._attended:
                return kind
        return "succeeded"

    def _continue(self) -> None:
        """A new contract leads out of a stop whose condition is gone; not out of what needs a person."""
        for tick in range(round(CLEARING / self.body.period)):
            if not self.spine.ending:
                return
            if tick % 2 == 0:  # pressed anew, as it counts only once the condition is gone
                self.spine.flag(Condition.CONTINUE)
            self._rest("continue", IDLE)

    def _settle(self, kind: OutcomeClass) -> tuple[OutcomeClass, str]:
        """Come to rest and end all permits; a fault on the way outranks every `kind` that is not a stop already.

        What did not go well may have left the hand around a thing: contacts that there still are stay permitted.
        """
        try:
            self.hold(self.config.settle, "settle")
            touches = () if kind == "succeeded" else self._leftover.beside(self._touches)
            self._leftover.keep(self._phase, touches, self.state, self.scene)
            self._touches = ()
            self._permit()
            self._seize()
        except Exception as error:
            why = self._broken(error).reason
            return (kind, "") if kind in BROKEN_OFF else ("stopped", why)
        return kind, ""

    # --- one action ---------------------------------------------------------------------------------------------

    def _act(self, action: Action, index: int) -> tuple[ActionResult, OutcomeClass]:
        started, first = self.state.stamp, len(self.log.trace)
        self.log.note(started, "action", f"{action.skill} {in_words(action)}", index=index)
        self._roles = roles_of(action, self.limb.holding)
        self._skill = action.skill
        try:
            self._observe()
            ending = self._carry_out(Running(self.limb, action.skill, action.params), index)
        except Exception as error:
            ending = self._broken(error)
        self.log.note(self.state.stamp, "action", f"{action.skill}: {ending.reason}", status=ending.status.value)
        kinds: dict[Status, OutcomeClass] = {
            Status.DONE: "succeeded", Status.FAILED: "failed", Status.TAKEN_OVER: "taken_over",
            Status.RUNNING: self._broken_off(ending),
        }  # fmt: skip
        status = "stopped" if ending.status is Status.RUNNING else ending.status.value
        kind = kinds[ending.status]
        Delta = self.log.mean_delta(first)
        return ActionResult(action.skill, status, ending.reason, started, self.state.stamp, Delta), kind

    def _broken_off(self, ending: Ending) -> OutcomeClass:
        """The outcome of an action that neither ended by itself nor was taken over."""
        return "aborted" if ending.reason == INTERRUPTED else self.spine.ending or "stopped"

    def _carry_out(self, running: Running, index: int) -> Ending:
        """Tick until the story ends or is ended; an end by the supervisor's order has status RUNNING."""
        end = self.state.stamp + LONGEST
        while not self.interrupted():
            if why := self._called_off():
                return why
            if self.spine.order.action >= Rung.HOVER:  # paused: the story waits, and so does its patience
                self._rest("paused", index)
                self._waited, end = self._waited + self.body.period, end + self.body.period
                continue
            nominal = running.nominal(self._senses())
            self._lap("skills")
            if isinstance(nominal, Ending):
                return nominal
            if self.state.stamp > end:
                return Ending(Status.TAKEN_OVER, f"{self._phase}: not done after {LONGEST:.0f} s")
            self._answer = self._rest("think", index) if nominal is None else self._tick(nominal, index)
            if self.spine.touched < 1.0:
                self._waited += (1.0 - max(0.0, self.spine.touched)) * self.body.period
        self.log.note(self.state.stamp, "takeover", "interrupted by a person: braking to rest")
        return Ending(Status.RUNNING, INTERRUPTED)

    def _called_off(self) -> Ending | None:
        """How the supervisor ends the contract, if it does."""
        ending = self.spine.ending
        if not ending:
            return None
        check = next(
            check for check in reversed(CHECKS) if check.name in self.spine.supervisor.tripped and check.ending
        )
        detail = f": {self._answer.explain()}" if check.cause is Cause.FILTER and self._answer else ""
        status = Status.TAKEN_OVER if ending == "taken_over" else Status.RUNNING
        return Ending(status, f"{check.says}{detail}")

    def _broken(self, error: Exception) -> Ending:
        """A fault of the program or of its inputs: the drive goes off at once, and what it was is noted."""
        self.robot.stop()
        self._on = False
        self.spine.flag(Condition.PROGRAM_ERROR)
        why = f"{type(error).__name__}: {error}"
        self.log.note(self.state.stamp, "fault", why, traceback=traceback.format_exc())
        return Ending(Status.RUNNING, why)


def roles_of(action: Action, holding: Holding | None) -> dict[str, str | None]:
    """What the action is about: its target and its destination, by name."""
    params = action.params
    target = params.get("object") or params.get("target") or (holding.name if holding else None)
    destination = params.get("destination")
    return {"target": str(target) if target else None, "destination": str(destination) if destination else None}


def in_words(action: Action) -> str:
    """Its parameters, for the log."""
    return ", ".join(
        f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}" for name, value in action.params.items()
    )


def not_run(action: Action) -> ActionResult:
    """What is said of an action that never began."""
    return ActionResult(action.skill, "not_run", "an earlier action did not succeed", 0.0, 0.0, 0.0)
