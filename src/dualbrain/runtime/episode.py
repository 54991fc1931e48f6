"""The episode on one screen: instruction → retrieval → proposal → gate → execution → outcome → memory (paper 3.4).

Data flows one way. Feedback is a value: a rejection in the second prompt, a weight that the next retrieval reads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import msgspec

from dualbrain.contracts.contract import Contract
from dualbrain.control.executor import Executor
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.grounding.instruction.recalled_steps import fit_recall
from dualbrain.grounding.instruction.review import Refusal, StopCommand
from dualbrain.grounding.outcome.evidence import Evidence
from dualbrain.grounding.outcome.instruction_truth import judge_decline
from dualbrain.grounding.outcome.outcome_check import check_outcome, collect_evidence
from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.memory import StoreReport
from dualbrain.planner.camera_image import CameraImage
from dualbrain.planner.protocol import describe_failure, has_answer
from dualbrain.records import Attempt, Episode, Judgement, Outcome, RetrievedContext
from dualbrain.runtime.agent import Agent
from dualbrain.runtime.planning.episode_request import EpisodeRequest
from dualbrain.runtime.planning.local_answer import answer_locally, explain_refusal, judge_stop, local_outcome
from dualbrain.runtime.planning.planner_request import PlanningContext, build_request, retrieve
from dualbrain.runtime.planning.planning_time import PlanningClock, decision_timings
from dualbrain.runtime.planning.proposing import (
    ProposalChecker,
    accepted_contract,
    open_gate,
    propose,
    propose_locally,
    propose_reused,
)
from dualbrain.runtime.planning.replanning import should_retry
from dualbrain.runtime.planning.verdict_text import format_verdict


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundTruth:
    """The part of an episode that only a simulation has.

    `start_contract` gets the accepted contract, `judge` returns the judgement on ground truth at the end, `versions`
    are the versions in use. Before planning, `image_features` returns the features of the camera image for the memory,
    and `camera_image` the image for the planner, if they are requested.
    """

    start_contract: Callable[[Contract], None]
    judge: Callable[[], Judgement | None]
    versions: dict[str, str]
    image_features: Callable[[], ImageFeatures | None] = lambda: None
    camera_image: Callable[[], CameraImage | None] = lambda: None


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """The result of planning: the `attempts` in their order, and all that they were made from.

    `local_answer` is None if memory or the planner was asked; `recall` and `withheld` are then the memories in the
    prompt (of a reused contract: its memory) and the skills of recalled steps that were left out, `retrieval_s` [s] is
    the time of the retrieval.
    """

    attempts: tuple[Attempt, ...]
    local_answer: StopCommand | Refusal | None = None
    recall: RetrievedContext = field(default_factory=RetrievedContext)
    withheld: tuple[str, ...] = ()
    retrieval_s: float = 0.0

    @property
    def contract(self) -> Contract | None:
        """The contract to execute, None if none was accepted."""
        return accepted_contract(self.attempts)


def run_episode(
    request: EpisodeRequest, agent: Agent, executor: Executor, clock: PlanningClock, ground_truth: GroundTruth
) -> tuple[Episode, StoreReport]:
    """Run one instruction through the loop; returns the episode and what memory changed.

    A stop command, and an instruction that the local layer declines, are answered without retrieval and planner.

    An episode that is followed by another try of the same instruction is not judged.
    """
    context = _planning_context(executor, ground_truth)
    binding_before, q_before = executor.log.binding.copy(), executor.state.q.copy()
    decision = _decide(request, agent, executor, clock, context)
    outcome, contract = _execute(decision, executor, ground_truth), decision.contract
    first, q_after = request.first_scene or context.scene, executor.state.q
    evidence = collect_evidence(
        first, executor.scene, contract, outcome, q_before, q_after, executor.robot_model, held=context.holding
    )
    if request.first_scene is not None:
        evidence = replace(evidence, in_hand_before=request.first_held, earlier_grips=request.earlier_grips)
    checked = check_outcome(request.instruction, outcome, contract, evidence)
    episode = Episode(
        id=request.id,
        started=request.started,
        instruction=request.instruction,
        robot=executor.robot_model.name,
        registry=context.registry.hash,
        seed=request.seed,
        scene=context.scene,
        summary=context.summary,
        recall=decision.recall,
        attempts=decision.attempts,
        contract=msgspec.to_builtins(contract) if contract else None,
        outcome=outcome,
        judgement=_judge(request, decision, outcome, evidence, ground_truth),
        timings=decision_timings(decision.attempts, decision.retrieval_s) | {"motion": outcome.duration},
        versions=ground_truth.versions,
        binding=dict(executor.log.binding - binding_before),
        second_opinion=checked.check,
        failure_feedback=request.failure_feedback,
        senses=checked.verdicts,
        changes=checked.changes,
        withheld_skills=decision.withheld,
    )
    return episode, agent.memory.store(episode, context.posture, now=request.now, image=context.image)


def log_weight_changes(log: FlightLog, t: float, stored: StoreReport) -> None:
    """Log the weight changes that an outcome caused, at the time `t` [s]."""
    for one in stored.weight_updates:
        text = f"{one.memory}: {one.rule}d" if one.rule == "reinforce" else f"{one.memory}: suppressed"
        log.note(t, "memory", text, episode_id=one.memory, before=one.before, after=one.after)


def _planning_context(executor: Executor, ground_truth: GroundTruth) -> PlanningContext:
    """The situation before planning."""
    return PlanningContext(
        robot_model=executor.robot_model,
        scene=executor.scene,
        holding=executor.held_object,
        posture=Posture(tuple(executor.state.q.tolist()), executor.state.opening),
        image=ground_truth.image_features(),
        camera_image=ground_truth.camera_image(),
    )


def _decide(
    request: EpisodeRequest, agent: Agent, executor: Executor, clock: PlanningClock, context: PlanningContext
) -> Decision:
    """Ask the local layer; if it has no answer, memory, documents and then the planner.

    A contract that succeeded in this place may answer instead of the planner; then nothing is retrieved for a prompt.
    """
    checker = ProposalChecker(
        instruction=request.instruction,
        instruction_check=request.instruction_check,
        withheld=(),
        unfinished=(executor.held_object or "") if request.continuation else "",
        context=context,
        executor=executor,
        gate=open_gate(request, executor, context),
        clock=clock,
    )
    answer = answer_locally(
        request.instruction, context, agent.planner, request.instruction_check, classifier=agent.clause_classifier
    )
    if answer is not None:
        attempts = propose_locally(answer, replace(checker, instruction_check="before_planning"))
        return Decision(attempts=attempts, local_answer=answer)
    attempts, reused = (), RetrievedContext()
    if _may_reuse(request):
        attempts, reused = propose_reused(request.instruction, agent.memory, checker)
    if accepted_contract(attempts) is not None:
        return Decision(attempts=attempts, recall=reused)
    found, retrieval_s = clock.measure(
        lambda: retrieve(request.instruction, context, agent.memory, request.max_exemplars, agent.retrieve_passages)
    )
    recall, withheld = fit_recall(found, request.instruction)
    plan_request = build_request(
        request.instruction, context, recall, request.failure_feedback, restrict=request.instruction_check == "all"
    )
    attempts = propose(request, plan_request, agent.planner, replace(checker, withheld=withheld), attempts)
    return Decision(attempts=attempts, recall=recall, withheld=withheld, retrieval_s=retrieval_s)


def _may_reuse(request: EpisodeRequest) -> bool:
    """Whether a remembered contract may answer: never after a contract that failed, nor for a planner under test."""
    return request.reuse_contracts and request.failure_feedback is None and request.instruction_check == "all"


def _execute(decision: Decision, executor: Executor, ground_truth: GroundTruth) -> Outcome:
    """Execute the accepted contract; the outcome is the robot's own verdict."""
    if contract := decision.contract:
        ground_truth.start_contract(contract)
        outcome = executor.execute(contract)
    else:
        outcome = _outcome_without_motion(executor, decision.attempts)
    answer = decision.local_answer
    return outcome if answer is None else local_outcome(answer, executor, outcome)


def _outcome_without_motion(executor: Executor, attempts: Sequence[Attempt]) -> Outcome:
    """The outcome when no contract was accepted and the robot did not move.

    A planner without an answer is a fault, which does not update memory; a rejected contract updates it.
    """
    if executor.interrupted():
        return Outcome(kind="aborted", reason="interrupted by a person before a contract was accepted")
    if not attempts:
        return Outcome(kind="rejected", reason=format_verdict(0, None))
    if not has_answer(attempts[-1].proposal):
        return Outcome(kind="stopped", reason=describe_failure(attempts[-1].proposal.finish_reason))
    return Outcome(kind="rejected", reason=format_verdict(len(attempts), attempts[-1].verdict))


def _judge(
    request: EpisodeRequest, decision: Decision, outcome: Outcome, evidence: Evidence, ground_truth: GroundTruth
) -> Judgement | None:
    """The judgement on ground truth; None before another try, and where nothing can judge."""
    judged = (
        None
        if should_retry(outcome, request.tries_left, machine_was_busy=request.machine_was_busy())
        else ground_truth.judge()
    )
    if isinstance(decision.local_answer, StopCommand):
        judged = judge_stop(outcome, judged)
    judged = judge_decline(judged, request.instruction, evidence)
    return explain_refusal(decision.local_answer, judged) if isinstance(decision.local_answer, Refusal) else judged
