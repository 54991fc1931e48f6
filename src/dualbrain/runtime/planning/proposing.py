"""The shots of one episode: a planner, the local layer or the contract before proposes, and the gate gives a verdict.

Every proposal becomes an attempt, which is written to the log. At most the last attempt is accepted and executed.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec

from dualbrain.contracts.contract import Contract, ContractHeader
from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.verdict import Accepted, Verdict
from dualbrain.control.executor import ContractGate, Executor
from dualbrain.core.text import storable_text
from dualbrain.grounding.instruction.review import Refusal, StopCommand
from dualbrain.grounding.vocabulary import planner_grants, scene_names
from dualbrain.planner.protocol import STOP, Planner, has_answer
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Attempt, Proposal, RetrievedContext
from dualbrain.runtime.planning.episode_request import EpisodeRequest, InstructionCheck
from dualbrain.runtime.planning.local_answer import local_proposal
from dualbrain.runtime.planning.planner_request import PlanningContext, Retriever
from dualbrain.runtime.planning.planning_time import PlanningClock
from dualbrain.runtime.planning.proposal_checks import (
    proposal_bytes,
    reject_before_gate,
    reject_idle,
    reject_mismatch,
)
from dualbrain.runtime.planning.reuse.reused_contract import find_reusable
from dualbrain.runtime.planning.verdict_text import format_attempt

CONTINUATION = "continuation of "
"""Beginning of the author of a contract whose actions remain of the contract before."""
CONTRACT_LIFETIME = 660.0
"""Time [s] after the request at which a contract that was not accepted expires; planners time out earlier."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ProposalChecker:
    """Checks the proposals for one instruction: its words (see `InstructionCheck`), then the gate.

    `withheld` are the skills of recalled steps that the instruction does not contain. `unfinished` is the object in the
    hand that the failed contract before was to put down, "" without one.
    """

    instruction: str
    instruction_check: InstructionCheck
    withheld: tuple[str, ...]
    unfinished: str
    context: PlanningContext
    executor: Executor
    gate: ContractGate
    clock: PlanningClock

    def check(self, proposal: Proposal, shot: int, requested_at: float, *, may_decline: bool = True) -> Attempt:
        """The attempt with the number `shot`, requested at `requested_at` [s], after it was written to the log."""
        verdict, gate_s = self.clock.measure(lambda: self._verdict(proposal, shot, requested_at, may_decline))
        attempt = Attempt(msgspec.structs.replace(proposal, text=storable_text(proposal.text)), verdict, gate_s)
        log, now = self.executor.log, self.executor.state.stamp
        log.attempt(now, attempt)
        log.note(now, "verdict", format_attempt(shot, attempt))
        return attempt

    def _verdict(self, proposal: Proposal, shot: int, requested_at: float, may_decline: bool) -> Verdict:
        reject_decline = not may_decline and not self.unfinished
        return (
            reject_before_gate(proposal, self.instruction, self.withheld)
            or (reject_idle(proposal, self.unfinished) if self.unfinished else None)
            or reject_mismatch(
                proposal, self.instruction, self.context, self.instruction_check, reject_decline=reject_decline
            )
            or self.gate.check(
                proposal_bytes(proposal),
                names=scene_names(self.executor.scene),
                principal=PLANNER,
                now=self.executor.state.stamp,
                header=self._header(shot, requested_at),
            )
        )

    def _header(self, shot: int, requested_at: float) -> ContractHeader:
        return ContractHeader(
            sequence=shot,
            issued=requested_at,
            expires=requested_at + CONTRACT_LIFETIME,
            principal=PLANNER,
            scene_version=self.context.scene.version,
        )


def open_gate(request: EpisodeRequest, executor: Executor, context: PlanningContext) -> ContractGate:
    """The gate of an episode, with the skills that its request grants."""
    return executor.gate(planner_grants(context.registry) if request.grants is None else request.grants)


def propose(
    request: EpisodeRequest,
    plan_request: PlanRequest,
    planner: Planner,
    checker: ProposalChecker,
    before: tuple[Attempt, ...] = (),
) -> tuple[Attempt, ...]:
    """Ask `planner` until the gate accepts a proposal, the planner gives no answer, or all shots are used.

    The attempts follow those `before`, which may be none. If there is a second shot, the planner may not decline an
    instruction that contracts can express at the first one.

    A planner that declines, or whose proposals are all rejected, while the hand holds the object of the contract before
    is followed by the remaining actions of that contract. A person who interrupts ends the shots.
    """
    executor = checker.executor
    can_continue = bool(request.continuation) and executor.held_object is not None
    attempts = list(before)
    for shot in range(1, request.max_shots + 1):
        requested_at, number = executor.state.stamp, len(attempts) + 1
        plan_request = msgspec.structs.replace(plan_request, contract_id=contract_id(number))
        proposal = checker.clock.wait_for(executor, lambda ask=plan_request: planner.propose(ask))
        if proposal is None:
            return tuple(attempts)
        may_decline = shot > 1 or request.max_shots == 1
        attempts.append(checker.check(proposal, number, requested_at, may_decline=may_decline))
        verdict = attempts[-1].verdict
        if can_continue and _is_accepted_decline(verdict):
            break
        if isinstance(verdict, Accepted) or not has_answer(proposal) or executor.interrupted():
            return tuple(attempts)
        plan_request = msgspec.structs.replace(plan_request, rejection=verdict)
    if can_continue:
        number = contract_id(len(attempts) + 1)
        proposal = _continuation(msgspec.structs.replace(plan_request, contract_id=number), request)
        attempts.append(checker.check(proposal, len(attempts) + 1, executor.state.stamp))
    return tuple(attempts)


def propose_reused(
    instruction: str, memory: Retriever, checker: ProposalChecker
) -> tuple[tuple[Attempt, ...], RetrievedContext]:
    """A contract that succeeded in this place as the only attempt, and its memory; no time passes for the robot.

    There is no attempt without such a memory, and none if a person interrupted.
    """
    executor = checker.executor
    found, seconds = checker.clock.measure(lambda: find_reusable(instruction, checker.context, memory, contract_id(1)))
    if found is None or executor.interrupted():
        return (), RetrievedContext()
    exemplar, proposal = found
    now = executor.state.stamp
    executor.log.note(
        now, "memory", f"proposing the contract of {exemplar.episode_id} again, which succeeded in this place"
    )
    attempt = checker.check(msgspec.structs.replace(proposal, timings={"total": seconds, "reuse": seconds}), 1, now)
    return (attempt,), RetrievedContext(exemplars=(exemplar,))


def contract_id(number: int) -> str:
    """The id of the contract with this number in its episode."""
    return f"c-{number:04d}"


def propose_locally(answer: StopCommand | Refusal, checker: ProposalChecker) -> tuple[Attempt, ...]:
    """The contract of the local layer as the only attempt; no time passes for the robot."""
    executor = checker.executor
    proposal, now = local_proposal(answer, checker.context.registry, contract_id(1)), executor.state.stamp
    if isinstance(answer, Refusal):
        executor.log.note(now, "planner", answer.reason)
    return (checker.check(proposal, 1, now),)


def accepted_contract(attempts: tuple[Attempt, ...]) -> Contract | None:
    """The contract that the gate accepted last, None if the last attempt was rejected or there was none."""
    verdict = attempts[-1].verdict if attempts else None
    return verdict.contract if isinstance(verdict, Accepted) else None


def _is_accepted_decline(verdict: Verdict) -> bool:
    """Whether the gate accepted a contract that does nothing but decline."""
    return isinstance(verdict, Accepted) and all(
        action.skill == "decline" for action in verdict.contract.action_sequence
    )


def _continuation(plan_request: PlanRequest, request: EpisodeRequest) -> Proposal:
    """The remaining actions of the contract before as a proposal: its author is that contract, not the planner."""
    contract = {
        "id": plan_request.contract_id,
        "context": {"robot": plan_request.robot, "registry": plan_request.registry_hash},
        "action_sequence": list(request.continuation),
    }
    before = request.failure_feedback.episode_id if request.failure_feedback else ""
    return Proposal(
        text=msgspec.json.encode(contract).decode(),
        finish_reason=STOP,
        planner=f"{CONTINUATION}{before}",
        timings={"total": 0.0},
    )
