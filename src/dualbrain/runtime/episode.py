"""The episode loop on one screen: instruction → retrieval → proposal → gate → execution → outcome → memory (paper 3.4).

Data flows one way. Feedback is a value: a rejection in the second prompt, a weight that the next retrieval reads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, get_args

import msgspec

from dualbrain.contracts.contract import Contract, ContractHeader
from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.verdict import Accepted, Rejected, Stage, Verdict
from dualbrain.control.executor import ContractGate, Executor, Grants
from dualbrain.core.text import storable_text
from dualbrain.errors import DECODE_ERRORS
from dualbrain.grounding.instruction.recalled_steps import fit_recall, reject_recalled_step
from dualbrain.grounding.instruction.review import Refusal, StopCommand
from dualbrain.grounding.outcome.instruction_truth import judge_decline
from dualbrain.grounding.outcome.outcome_check import check_outcome, collect_evidence
from dualbrain.grounding.vocabulary import planner_grants, scene_names
from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.memory import StoreReport
from dualbrain.planner.prompt.full_prompt import MAX_RECALLED
from dualbrain.planner.protocol import STOP, describe_failure, has_answer
from dualbrain.planner.request import PlanRequest
from dualbrain.records import (
    Attempt,
    Episode,
    FailureFeedback,
    Judgement,
    JudgementBasis,
    Outcome,
    Proposal,
    RetrievedContext,
    Scene,
)
from dualbrain.runtime.agent import Agent
from dualbrain.runtime.local_answer import STOPPED, InstructionCheck, answer_locally, local_proposal, reject_mismatch
from dualbrain.runtime.planner_request import PlanningContext, build_request, retrieve
from dualbrain.runtime.planning_time import PlanningClock, decision_timings
from dualbrain.runtime.replanning import should_retry
from dualbrain.skills.registry import skill_registry

STAGES = get_args(Stage)
"""The stages of the gate, in their order."""
CONTINUATION = "continuation of "
"""Beginning of the author of a contract whose actions remain of the contract before."""
STOP_TIME = 0.5
"""Time at rest after a stop command for which the gate accepts no contract [s]."""
CONTRACT_LIFETIME = 660.0
"""Time [s] after the request at which a contract that was not accepted expires; planners time out earlier."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeRequest:
    """One instruction and the limits on its episode.

    `started` is its date (ISO 8601), `now` [s, 1970 UTC] the time under which memory stores it. The planner has
    `max_shots` proposals and is shown at most `max_exemplars` memories (0: neither exemplars nor warnings, as for a
    given contract). `tries_left` contracts may still be executed for the instruction, this one included;
    `failure_feedback` is the feedback on the one before, `continuation` the actions that remain of it for the object in
    the hand: if the gate rejects every proposal, or the planner declines, the gate gets a contract of these actions.
    `first_scene` is the scene in which the instruction was given, if an earlier contract may have changed it. `grants`
    defines which principal may call which skills; by default the planner may call all of them.
    """

    id: str
    started: str
    instruction: str
    seed: int
    now: float = 0.0
    max_shots: int = 2
    max_exemplars: int = MAX_RECALLED
    tries_left: int = 1
    failure_feedback: FailureFeedback | None = None
    continuation: tuple[dict[str, Any], ...] = ()
    grants: Grants | None = None
    first_scene: Scene | None = None
    instruction_check: InstructionCheck = "all"
    """Which checks of the words the instruction and the contract pass."""


@dataclass(frozen=True, slots=True)
class GroundTruth:
    """The part of an episode that only a simulation has.

    `start_contract` gets the accepted contract, `judge` returns the judgement on ground truth at the end, `versions`
    are the versions in use, `image_features` returns the features of the camera image before planning, if there is one.
    """

    start_contract: Callable[[Contract], None]
    judge: Callable[[], Judgement | None]
    versions: dict[str, str]
    image_features: Callable[[], ImageFeatures | None] = lambda: None


def run_episode(
    request: EpisodeRequest, agent: Agent, executor: Executor, clock: PlanningClock, ground_truth: GroundTruth
) -> tuple[Episode, StoreReport]:
    """Run one instruction through the loop; returns the episode and what memory changed.

    A stop command, and an instruction that the local layer declines, are answered without retrieval and planner.

    An episode that is followed by another try of the same instruction is not judged.
    """
    registry, scene = skill_registry(executor.robot_model), executor.scene
    posture = Posture(tuple(executor.state.q.tolist()), executor.state.opening)
    context = PlanningContext(
        robot_model=executor.robot_model,
        scene=scene,
        holding=executor.held_object,
        posture=posture,
        image=ground_truth.image_features(),
    )
    binding_before, q_before = executor.log.binding.copy(), executor.state.q.copy()
    withheld: tuple[str, ...] = ()
    answer = answer_locally(request.instruction, context, agent.planner, request.instruction_check)
    if answer is None:
        recall, retrieval_s = clock.measure(
            lambda: retrieve(request.instruction, context, agent.memory, request.max_exemplars, agent.retrieve_passages)
        )
        recall, withheld = fit_recall(recall, request.instruction)
        plan_request = build_request(request.instruction, context, recall, request.failure_feedback)
        attempts, verdict = _propose(request, agent, executor, clock, plan_request, context, withheld)
    else:
        recall, retrieval_s = RetrievedContext(), 0.0
        attempts, verdict = _propose_locally(request, answer, executor, clock, context)
    contract = verdict.contract if isinstance(verdict, Accepted) else None
    if contract:
        ground_truth.start_contract(contract)
    outcome = executor.execute(contract) if contract else _outcome_without_motion(executor, attempts)
    outcome = outcome if answer is None else _local_outcome(answer, executor, outcome)
    first, q_after = request.first_scene or scene, executor.state.q
    evidence = collect_evidence(first, executor.scene, contract, outcome, q_before, q_after, executor.robot_model)
    checked = check_outcome(request.instruction, outcome, contract, evidence)
    judged = None if should_retry(outcome, request.tries_left) else ground_truth.judge()
    if isinstance(answer, StopCommand):
        judged = _judge_stop(outcome, judged)
    episode = Episode(
        id=request.id,
        started=request.started,
        instruction=request.instruction,
        robot=executor.robot_model.name,
        registry=registry.hash,
        seed=request.seed,
        scene=scene,
        summary=context.summary,
        recall=recall,
        attempts=tuple(attempts),
        contract=msgspec.to_builtins(contract) if contract else None,
        outcome=outcome,
        judgement=judge_decline(judged, request.instruction, evidence),
        timings=decision_timings(attempts, retrieval_s) | {"motion": outcome.duration},
        versions=ground_truth.versions,
        binding=dict(executor.log.binding - binding_before),
        second_opinion=checked.check,
        failure_feedback=request.failure_feedback,
        senses=checked.verdicts,
        changes=checked.changes,
        withheld_skills=withheld,
    )
    return episode, agent.memory.store(episode, posture, now=request.now, image=context.image)


def _propose(
    request: EpisodeRequest,
    agent: Agent,
    executor: Executor,
    clock: PlanningClock,
    plan_request: PlanRequest,
    context: PlanningContext,
    withheld: tuple[str, ...],
) -> tuple[list[Attempt], Verdict | None]:
    """Request contracts until the gate accepts one, the planner gives no answer, or all shots are used."""
    registry = skill_registry(executor.robot_model)
    gate = executor.gate(planner_grants(registry) if request.grants is None else request.grants)
    attempts: list[Attempt] = []

    def check(proposal: Proposal, requested_at: float) -> Verdict:
        """The verdict on a proposal, which becomes the next attempt."""
        shot = len(attempts) + 1
        header = _header(shot, requested_at, context)
        verdict, gate_s = clock.measure(
            lambda: (
                reject_before_gate(proposal, request.instruction, withheld)
                or reject_mismatch(proposal, request.instruction, context, request.instruction_check)
                or _check(gate, proposal, scene_names(executor.scene), executor.state.stamp, header)
            )
        )
        attempts.append(_logged_attempt(executor, shot, proposal, verdict, gate_s))
        return verdict

    verdict: Verdict | None = None
    can_continue = bool(request.continuation) and executor.held_object is not None
    for _ in range(request.max_shots):
        requested_at = executor.state.stamp
        proposal = clock.wait_for(executor, lambda ask=plan_request: agent.planner.propose(ask))
        if proposal is None:
            return attempts, verdict
        verdict = check(proposal, requested_at)
        if not has_answer(proposal):
            return attempts, verdict
        if isinstance(verdict, Accepted):
            if not (can_continue and is_decline(verdict.contract)):
                return attempts, verdict
            break
        contract_id = f"c-{len(attempts) + 1:04d}"
        plan_request = msgspec.structs.replace(plan_request, rejection=verdict, contract_id=contract_id)
    if can_continue:
        verdict = check(_continuation(plan_request, request), executor.state.stamp)
    return attempts, verdict


def is_decline(contract: Contract) -> bool:
    """Whether `contract` does nothing but decline."""
    return all(action.skill == "decline" for action in contract.action_sequence)


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
        constrained_by="the contract before",
        timings={"total": 0.0},
    )


def _header(shot: int, requested_at: float, context: PlanningContext) -> ContractHeader:
    return ContractHeader(
        sequence=shot,
        issued=requested_at,
        expires=requested_at + CONTRACT_LIFETIME,
        principal=PLANNER,
        scene_version=context.scene.version,
    )


def _logged_attempt(executor: Executor, shot: int, proposal: Proposal, verdict: Verdict, gate_s: float) -> Attempt:
    """The attempt, after it was written to the log."""
    attempt = Attempt(msgspec.structs.replace(proposal, text=storable_text(proposal.text)), verdict, gate_s)
    executor.log.attempt(executor.state.stamp, attempt)
    executor.log.note(executor.state.stamp, "verdict", _format_attempt(shot, attempt))
    return attempt


# --- answers of the local layer ---------------------------------------------------------------------------------------


def _propose_locally(
    request: EpisodeRequest,
    answer: StopCommand | Refusal,
    executor: Executor,
    clock: PlanningClock,
    context: PlanningContext,
) -> tuple[list[Attempt], Verdict]:
    """The contract of the local layer and the gate's verdict on it; no time passes for the robot."""
    registry = context.registry
    gate = executor.gate(planner_grants(registry) if request.grants is None else request.grants)
    proposal, now = local_proposal(answer, registry, "c-0001"), executor.state.stamp
    if isinstance(answer, Refusal):
        executor.log.note(now, "planner", answer.reason)
    verdict, gate_s = clock.measure(
        lambda: _check(gate, proposal, scene_names(executor.scene), now, _header(1, now, context))
    )
    return [_logged_attempt(executor, 1, proposal, verdict, gate_s)], verdict


def _local_outcome(answer: StopCommand | Refusal, executor: Executor, outcome: Outcome) -> Outcome:
    """The outcome of a local answer, with its reason in words.

    The site may grant neither `hold` nor `decline` to the planner; a robot without an accepted contract rests anyway.
    """
    if executor.interrupted() or outcome.kind not in ("succeeded", "declined", "rejected"):
        return outcome
    if isinstance(answer, Refusal):
        return msgspec.structs.replace(outcome, kind="declined", reason=answer.reason)
    if outcome.kind == "rejected":
        executor.hold(STOP_TIME, "stop")
    return msgspec.structs.replace(outcome, kind="succeeded", reason=STOPPED)


def _judge_stop(outcome: Outcome, judgement: Judgement | None) -> Judgement | None:
    """The judgement of a stop command: a robot at rest fulfils it; violations count as always."""
    if judgement is None or outcome.kind != "succeeded":
        return judgement
    basis = JudgementBasis(reason="The robot stopped, as the stop command states.")
    return msgspec.structs.replace(judgement, success=True, progress=1.0, basis=basis)


# --- verdicts ---------------------------------------------------------------------------------------------------------


def reject_incomplete(proposal: Proposal) -> Rejected | None:
    """The rejection of an answer that was cut or is missing; None for a complete answer."""
    if proposal.finish_reason == STOP:
        return None
    cut = "the answer is not whole, so it is no contract"
    return Rejected(
        stage="syntax",
        pointer="",
        got=proposal.finish_reason,
        allowed=STOP,
        hint=cut if has_answer(proposal) else "the planner did not answer, so there is no contract",
    )


def reject_before_gate(proposal: Proposal, instruction: str, withheld: tuple[str, ...]) -> Rejected | None:
    """The rejection of an answer that no gate sees: incomplete, or with a step that only a recalled episode contains.

    The check is before the gate because a gatekeeper starts the motion as soon as its gate accepts.
    """
    if rejected := reject_incomplete(proposal):
        return rejected
    if not withheld:
        return None
    try:
        contract = msgspec.json.decode(proposal.text.encode("utf-8", "surrogatepass"), type=Contract)
    except DECODE_ERRORS:
        return None  # the gate states why
    return reject_recalled_step(msgspec.to_builtins(contract), withheld, instruction)


def _check(gate: ContractGate, proposal: Proposal, names: SceneNames, now: float, header: ContractHeader) -> Verdict:
    """The gate's verdict on a proposal."""
    data = proposal.text.encode("utf-8", "surrogatepass")
    return gate.check(data, names=names, principal=PLANNER, now=now, header=header)


def _outcome_without_motion(executor: Executor, attempts: Sequence[Attempt]) -> Outcome:
    """The outcome when no contract was accepted and the robot did not move.

    A planner without an answer is a fault, which does not update memory; a rejected contract updates it.
    """
    if executor.interrupted():
        return Outcome(kind="aborted", reason="interrupted by a person before a contract was accepted")
    if not attempts:
        return Outcome(kind="rejected", reason=_format_verdict(0, None))
    if not has_answer(attempts[-1].proposal):
        return Outcome(kind="stopped", reason=describe_failure(attempts[-1].proposal.finish_reason))
    return Outcome(kind="rejected", reason=_format_verdict(len(attempts), attempts[-1].verdict))


def _format_attempt(shot: int, attempt: Attempt) -> str:
    finish_reason = attempt.proposal.finish_reason
    return _format_verdict(shot, attempt.verdict) if has_answer(attempt.proposal) else describe_failure(finish_reason)


def _format_verdict(shot: int, verdict: Verdict | None) -> str:
    match verdict:
        case Accepted(contract):
            skills = " → ".join(action.skill for action in contract.action_sequence)
            return f"shot {shot}: accepted, {_format_passed_stages(len(STAGES))}: {skills}"
        case Rejected(stage=stage, pointer=pointer, got=got, allowed=_, hint=hint):
            passed = _format_passed_stages(STAGES.index(stage))
            return f"shot {shot}: rejected, {passed}{stage} ✗ at {pointer or '/'}: got {got!r}; {hint}"
        case None:
            return "no shot was taken"


def _format_passed_stages(count: int) -> str:
    return " ".join(f"{stage} ✓" for stage in STAGES[:count]) + (" " if 0 < count < len(STAGES) else "")
